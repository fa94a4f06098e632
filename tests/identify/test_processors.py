"""Seeded trajectories are the same on every processor, by what searches are given and by what they
end at, and so are the figures of a run.

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
for name, criterion in (("rss6", "observability"), ("delta3", "information")):
    excitation = paper.excitation.model_copy(update={"criterion": criterion})
    scenario = paper.model_copy(update={"excitation": excitation})
    design = Setup(scenario, loaded=dynamics.load_robot(name)).design
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
KEPT = Path(__file__).parent / "trajectories.json"  # what FOUND prints on Haswell
RUN = """
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from identify import load_scenario, pipeline
from identify.files.run_folder import load_result
from identify.progress import SilentProgress
from identify.setup import Setup

setup, progress = Setup(load_scenario("quick", renderer="statistical")), SilentProgress()
with TemporaryDirectory() as name:
    folder = Path(name)
    pipeline.excite(setup, folder, progress)
    taught = pipeline.record(folder, progress)
    pipeline.identify(folder, progress)
    pipeline.validate(folder, progress, taught=taught)
    print(json.dumps(load_result(folder / "result.json")))
"""
# Entries of a result that say when and how fast, and digests of files.
NO_FIGURES = {"sha256", "made_of", "date", "seconds", "stereo_frames_per_second"}
# Condition numbers. Their smallest singular value is a difference of far larger numbers.
ROUNDING = {"with_guess", "poses_alone"}


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


# The suite without the long proofs compares Haswell with one more kind, which every machine has.
OFTEN = "SkylakeX" if has_avx512() else "without AVX"


def long_proof(processor):
    """Parameter for the long proofs, left out where the processor cannot be had."""
    needless = pytest.mark.skipif(
        processor == "SkylakeX" and not has_avx512(), reason="this processor has no AVX-512"
    )
    return pytest.param(processor, marks=[pytest.mark.thorough, needless])


SELDOM = [long_proof(name) for name in PROCESSORS if name not in ("Haswell", OFTEN)]


@pytest.mark.parametrize("processor", [OFTEN, *SELDOM])
def test_ipopt_is_given_the_same_problem_to_the_last_bit(given, processor):
    """Objective with its derivatives and limits, as CasADi writes them; IPOPT's own BLAS is one for
    all.
    """
    assert len(given[0]) == 4
    assert on(processor, GIVEN) == given


@pytest.mark.thorough
@pytest.mark.parametrize("processor", [OFTEN, *SELDOM, long_proof("Haswell")])
def test_built_in_scenarios_have_the_same_trajectories(processor):
    """Those of `paper` end a search of a thousand steps that would carry a last bit to the second
    digit.
    """
    kept = json.loads(KEPT.read_text(encoding="utf-8"))
    found = on(processor, FOUND)
    assert len(found) == len(kept) == 1 + 10 + 1 + 2 + 1 + 10
    for one, other in zip(kept, found, strict=True):
        np.testing.assert_allclose(other, one, rtol=0, atol=1e-6)


def figures(entry, path=(), scale=0.0):
    """Yield place, value and scale of all that a result says, but condition numbers and times.

    The scale of a number is its own size. In the entry of a parameter it is that of the largest
    number there, because the others are in its unit: a guess may be nought but for rounding.
    """
    if isinstance(entry, dict):
        if "estimate" in entry:
            of_unit = [entry["initial"], entry["true"], entry["estimate"], entry["std"]]
            scale = max(abs(value) for value in of_unit if value is not None)
        for key, value in entry.items():
            if key not in NO_FIGURES | ROUNDING:
                yield from figures(value, (*path, key), scale)
    elif isinstance(entry, list):
        for number, value in enumerate(entry):
            yield from figures(value, (*path, number), scale)
    elif isinstance(entry, float):
        yield path, entry, max(scale, abs(entry))
    else:
        yield path, entry, 0.0


@pytest.fixture(scope="module")
def result():
    return on("Haswell", RUN)[0]


@pytest.mark.thorough
@pytest.mark.parametrize(
    "processor", [long_proof(name) for name in PROCESSORS if name != "Haswell"]
)
def test_figures_of_a_run_agree_to_1e_7(result, processor, record_property):
    """Estimates, intervals, errors and tests; the images are drawn centres."""
    (other,) = on(processor, RUN)
    worst = 0.0
    for (path, one, scale), (place, two, _) in zip(figures(result), figures(other), strict=True):
        assert path == place
        if isinstance(one, float):
            assert abs(two - one) <= 1e-7 * scale, (path, one, two)
            worst = max(worst, abs(two - one) / scale if scale else 0.0)
        else:
            assert one == two, path
    record_property("worst", worst)
