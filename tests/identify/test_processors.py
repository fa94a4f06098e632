"""Seeded trajectories are the same on every processor, by what searches are given and by what they
end at.

BLAS kernels, numpy's vectorised functions and compiled code are chosen when a process starts; so
each processor is a process, with the kernels of that one.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow

PROCESSORS = {
    "Haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "SkylakeX": {"OPENBLAS_CORETYPE": "SkylakeX"},
    "Zen": {"OPENBLAS_CORETYPE": "Zen"},
    "without AVX": {
        "OPENBLAS_CORETYPE": "Prescott",
        "NPY_DISABLE_CPU_FEATURES": "X86_V3,X86_V4,AVX512_ICL",
    },
    "numba for Haswell": {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma,-avx512f"},
}
GIVEN = """
import hashlib, json, numpy as np, dynamics
from identify import load_scenario
from identify.setup import Setup

paper, given = load_scenario("paper"), {}
for criterion in ("observability", "information"):
    excitation = paper.excitation.model_copy(update={"criterion": criterion})
    scenario = paper.model_copy(update={"excitation": excitation})
    for name in ("rss6", "delta3"):
        robot = dynamics.load_robot(name)
        design = Setup(scenario, loaded=robot).design
        problem = design.search_problem(design.candidates(4, 0))
        for function in (problem.criterion.smooth, problem.constraints.shares):
            digest = hashlib.sha256(function.serialize().encode()).hexdigest()
            given[f"{name} {criterion} {function.name()}"] = digest
print(json.dumps(given))
"""
FOUND = """
import json, numpy as np
from identify import load_scenario
from identify.setup import Setup

for name in ("paper", "quick", "geometry"):
    scenario = load_scenario(name)
    designed = Setup(scenario).trajectories
    for one in (designed.excitation, *designed.validation):
        print(json.dumps([*one.sine.ravel(), *one.cosine.ravel(), *one.offset]))
"""


def has_avx512():
    information = Path("/proc/cpuinfo")
    return information.exists() and "avx512f" in information.read_text(encoding="utf-8")


def on(processor, code):
    """Lines that a script prints on a processor."""
    environment = {
        key: value
        for key, value in os.environ.items()
        if not key.startswith(("OPENBLAS", "NUMBA_CPU"))
    }
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env={**environment, **PROCESSORS[processor]},
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


@pytest.fixture(scope="module")
def given():
    return on("Haswell", GIVEN)


@pytest.fixture(scope="module")
def found():
    return [np.array(line) for line in on("Haswell", FOUND)]


SKYLAKE = pytest.param(
    "SkylakeX", marks=pytest.mark.skipif(not has_avx512(), reason="this processor has no AVX-512")
)
OFTEN = [SKYLAKE, "without AVX"]
SELDOM = [pytest.param(name, marks=pytest.mark.thorough) for name in ("Zen", "numba for Haswell")]


@pytest.mark.parametrize("processor", [*OFTEN, *SELDOM])
def test_ipopt_is_given_the_same_problem_to_the_last_bit(given, processor):
    """Objective with its derivatives and limits, as CasADi writes them; IPOPT's own BLAS is one for
    all.
    """
    assert len(given[0]) == 8
    assert on(processor, GIVEN) == given


@pytest.mark.parametrize(
    "processor", [SKYLAKE, pytest.param("without AVX", marks=pytest.mark.thorough), *SELDOM]
)
def test_built_in_scenarios_have_the_same_trajectories(found, processor):
    """Those of `paper` end a search of a thousand steps that would carry a last bit to the second
    digit.
    """
    others = on(processor, FOUND)
    assert len(others) == len(found) == 1 + 10 + 1 + 2 + 1 + 10
    for one, other in zip(found, others, strict=True):
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-6)
