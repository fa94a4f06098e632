"""Numbers of the random streams of this package, which make the streams of a seed independent.

Streams of an experiment are children of its seed, `SeedSequence(seed, spawn_key=(stream, ...))`.
Streams of a single run append the number of the run. The search of a trajectory and the teaching
have the same number but no common random numbers: the search draws from the child itself, and the
sensor from a seed that the child generates.

Streams outside an experiment mix their number into the seed, `SeedSequence([seed, stream])`, or are
the same for every seed. A number such as 5 can be used for both purposes, because a mixed seed and
a child are different sequences.

Each kind of row of a study numbers the children of the row's sequence in its own module. `cmmsim`
numbers the children of a sensor's seed.
"""

import numpy as np

# Children of the seed of an experiment.
EXCITATION = 0  # candidates of the exciting trajectory
UNSEEN = 1  # validation trajectories
SEARCH = 2  # search from the candidates
TEACHING = 2  # teaching of the sensor
ANCHOR = 3  # error of the quantity that fixes the scale
DESIGN = 7  # exciting trajectories of several runs
LOAD = 8  # true load
CALIBRATION = 9  # calibration of the cameras, as the estimator knows it
MEAN_LATENCY = 10  # true mean latency
STATIC_POSES = 14  # candidate poses of a kinematic calibration
UNSEEN_POSES = 15  # validation poses of a kinematic calibration
ENCODER_OFFSETS = 16  # offsets of the encoders
ENCODERS = 17  # readings of the encoders
STATIC_NOISE = 18  # noise of the measured static poses
TRUE_GEOMETRY = 19  # true geometry, drawn about a calibrated geometry
JOINT_ZEROS = 26  # true zeros of the joints, with the seed of the geometry
EXPOSURES = 25  # true delay of the right camera's exposure

# Children of the same seed. The number of the run is appended.
NOISE = 4  # noise of the sensor
LATENCY = 5  # latency of the frames
PREDICTION = 6  # noise of the predicted poses
TRACKED = 24  # poses drawn for the contributions to the error of a tracked motion

# Mixed with a seed, or the same for every seed.
UNCERTAINTY = 5  # with a record's seed: repeated experiments behind the standard deviations
INSTRUMENTS = 20  # with a seed: instruments at the joints
ROUTES_UNCERTAINTY = 21  # alone: repeated experiments of the output-error estimators
DISTURBED_COPIES = 22  # alone: disturbed copies of a record for total least squares
SAMPLED_POINTS = 1  # with a study's seed, whose children are the rows: points of a sample
RESAMPLING = 301  # with a sensor's seed: resampled frames of the moving bar


def child(seed: int | np.random.SeedSequence, *stream: int) -> np.random.SeedSequence:
    """Return the sequence of a stream, independent of all other streams of the seed.

    seed     Seed of an experiment, or sequence of a study's row. The sequence is not changed.
    *stream  Number of the stream, and further numbers such as the number of the run.
    """
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, *stream))


def stream_seed(seed: int | np.random.SeedSequence, *stream: int) -> int:
    """Return the integer seed of a stream."""
    return int(child(seed, *stream).generate_state(1)[0])


def integer_seed(seed: int | np.random.SeedSequence) -> int:
    """Return the integer seed of an experiment, given as such or as a sequence of a study's row."""
    if isinstance(seed, np.random.SeedSequence):
        return int(seed.generate_state(1)[0])
    return seed


def mixed_generator(stream: int, *seed: int) -> np.random.Generator:
    """Return the generator of a stream outside an experiment, with or without a seed."""
    return np.random.default_rng([*seed, stream])
