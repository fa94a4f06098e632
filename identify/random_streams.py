"""Every random stream of this package, by number: who draws what of one seed, so that no two draw the same.

The streams of an experiment are children of its seed, of `SeedSequence(seed, spawn_key=(stream, ...))`; what is drawn
once a run has the run's number behind its own. The search of a trajectory and the teaching share a number, and not a
draw: the search draws from the child itself, the sensor from a seed that the child generates.

Streams beside an experiment mix their number into the seed, or are the same for every seed: `SeedSequence([seed,
stream])`. Their numbers may be those of children, as 5 is: a mixed seed and a child are not the same sequence.

Each kind of a study's row numbers the children of the row's sequence itself, and `cmmsim` those of a sensor's seed.
"""

import numpy as np

EXCITATION, UNSEEN, SEARCH = 0, 1, 2
"""Exciting candidates, unseen trajectories, and the search from the candidates."""
TEACHING, ANCHOR = 2, 3
"""The sensor's teaching, and the error of what fixes the scale."""
STATIC_POSES, UNSEEN_POSES, ENCODER_OFFSETS, ENCODERS, STATIC_NOISE = 14, 15, 16, 17, 18
"""Of a kinematic calibration: candidates and unseen poses, offsets of the encoders and their readings, drawn poses."""
TRUE_GEOMETRY = 19
"""The true geometry about one that was calibrated before."""
NOISE, LATENCY, PREDICTION = 4, 5, 6
"""Of each run: the sensor's noise, the latency of its frames, the noise in what is predicted of it."""
DESIGN, LOAD, CALIBRATION, MEAN_LATENCY = 7, 8, 9, 10
"""The exciting trajectories of several runs, the true load, what is known of the cameras, and the true mean latency."""
TRACKED, EXPOSURES = 24, 25
"""Of each motion that is followed: the drawn poses by which the shares of its error are known. And by how much the
right camera truly exposes later."""

UNCERTAINTY = 5
"""Mixed with a record's seed: the repeated experiments behind an identification's standard deviations."""
INSTRUMENTS = 20
"""Mixed with a seed: the instruments at the joints."""
ROUTES_UNCERTAINTY, DISTURBED_COPIES = 21, 22
"""The same for every seed: repeated experiments behind the standard deviations of the output-error estimators, and
disturbed copies of a record for total least squares."""
SAMPLED_POINTS = 1
"""Mixed with a study's seed, of which its rows are the children: the points of a sample."""
RESAMPLING = 301
"""Mixed with a sensor's seed: the frames of the moving bar that are drawn again."""


def child(seed: int | np.random.SeedSequence, *stream: int) -> np.random.SeedSequence:
    """The stream's own sequence, independent of all others of a seed or of a row's sequence, which is left as it is."""
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    return np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, *stream))


def stream_seed(seed: int | np.random.SeedSequence, *stream: int) -> int:
    """A plain integer seed of a stream."""
    return int(child(seed, *stream).generate_state(1)[0])


def mixed_generator(stream: int, *seed: int) -> np.random.Generator:
    """Generator of a stream beside an experiment, for a seed or the same for all."""
    return np.random.default_rng([*seed, stream])
