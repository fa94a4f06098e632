"""The streams of one seed: always the same numbers, and no two alike."""

import numpy as np
import pytest

from identify import random_streams
from identify.random_streams import child, mixed_generator, stream_seed

CHILDREN = (
    *(
        "EXCITATION",
        "UNSEEN",
        "SEARCH",
        "ANCHOR",
        "NOISE",
        "LATENCY",
        "PREDICTION",
        "DESIGN",
        "LOAD",
    ),
    *("CALIBRATION", "MEAN_LATENCY", "EXPOSURES", "JOINT_ZEROS"),
    *("STATIC_POSES", "UNSEEN_POSES", "ENCODER_OFFSETS", "ENCODERS", "STATIC_NOISE"),
)
MIXED = ("UNCERTAINTY", "INSTRUMENTS", "RESAMPLING", "SAMPLED_POINTS")


def test_children_are_those_that_numpy_spawns_and_leave_a_rows_sequence_as_it_is():
    for number, spawned in enumerate(np.random.SeedSequence(3).spawn(4)):
        assert child(3, number).generate_state(4).tolist() == spawned.generate_state(4).tolist()
        assert stream_seed(3, number) == spawned.generate_state(1)[0]
    row = np.random.SeedSequence(3, spawn_key=(5,))
    assert child(row, 1).generate_state(4).tolist() == child(3, 5, 1).generate_state(4).tolist()
    assert row.n_children_spawned == 0


@pytest.mark.parametrize("seed", [0, 1, 12345])
def test_no_two_streams_draw_the_same(seed):
    """Nor do streams of the same number: a seed that a child generates, and one that is mixed,
    begin others.
    """
    generators = {
        name: np.random.default_rng(child(seed, getattr(random_streams, name))) for name in CHILDREN
    }
    generators["TEACHING"] = np.random.default_rng(stream_seed(seed, random_streams.TEACHING))
    generators |= {
        f"NOISE {run}": np.random.default_rng(child(seed, random_streams.NOISE, run))
        for run in (0, 1)
    }
    generators |= {name: mixed_generator(getattr(random_streams, name), seed) for name in MIXED}
    generators |= {
        name: mixed_generator(getattr(random_streams, name))
        for name in ("ROUTES_UNCERTAINTY", "DISTURBED_COPIES")
    }
    drawn = {name: generator.integers(2**63) for name, generator in generators.items()}
    assert len(set(drawn.values())) == len(drawn), drawn


def test_numbers_are_those_of_every_version():
    names = [name for name in vars(random_streams) if name.isupper()]
    assert {name: getattr(random_streams, name) for name in names} == {
        "EXCITATION": 0, "UNSEEN": 1, "SEARCH": 2, "TEACHING": 2, "ANCHOR": 3, "NOISE": 4, "LATENCY": 5,
        "PREDICTION": 6, "DESIGN": 7, "LOAD": 8, "CALIBRATION": 9, "MEAN_LATENCY": 10, "UNCERTAINTY": 5,
        "INSTRUMENTS": 20, "ROUTES_UNCERTAINTY": 21, "DISTURBED_COPIES": 22, "STATIC_POSES": 14, "UNSEEN_POSES": 15,
        "TRUE_GEOMETRY": 19, "ENCODER_OFFSETS": 16, "ENCODERS": 17, "STATIC_NOISE": 18, "SAMPLED_POINTS": 1,
        "RESAMPLING": 301, "TRACKED": 24, "EXPOSURES": 25, "JOINT_ZEROS": 26,
    }  # fmt: skip
    assert mixed_generator(21).integers(2**63) == np.random.default_rng(21).integers(2**63)
    assert mixed_generator(20, 7).integers(2**63) == np.random.default_rng([7, 20]).integers(2**63)
