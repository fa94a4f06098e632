"""Machine code against CasADi's virtual machine; its cache: content as key, whole files of our own
only.
"""

import os
import subprocess
import sys
import time
import warnings
from fractions import Fraction
from inspect import getsource
from pathlib import Path
from unittest.mock import Mock

import casadi as ca
import numpy as np
import pytest

from dynamics import load_robot
from dynamics.closure import closure_function
from dynamics.compiled import machine_code, object_files
from dynamics.compiled.kernel import call_columns, entry, kernel, plain
from dynamics.compiled.lanes import NAMES, ColumnFunction, PartedFunction, graph_of, lane_groups
from dynamics.compiled.machine_code import compiled_functions
from dynamics.compiled.object_files import CacheWarning, load_object, save_object
from dynamics.compiled.operations import CALLED, MEANING
from dynamics.compiled.quick_arithmetic import quickened
from dynamics.errors import DynamicsError
from dynamics.rigid_body.accelerations import slope_derivative
from dynamics.rigid_body.equation_of_motion import motion_functions
from dynamics.rigid_body.virtual_work import robot_functions
from dynamics.robot_functions import HOT
from tests.dynamics.conftest import BOX

SPECIAL = (
    0.0,
    -0.0,
    1.0,
    -1.0,
    2.0,
    3.0,
    0.5,
    -2.5,
    1e-310,
    1e308,
    -1e308,
    np.inf,
    -np.inf,
    np.nan,
)
X, Y = ca.SX.sym("x"), ca.SX.sym("y")
OPERATIONS = [name for name in (*MEANING, *CALLED) if name in NAMES.values()]


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("CMMSIM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def _square():
    x = ca.SX.sym("x", 2)
    return [ca.Function("square", [x], [x * x])]


def square(build=_square, content=b"square"):
    """The compiled square's answer to (3, 4)."""
    return compiled_functions(content, build)["square"](np.array([[3.0, 4.0]]))[0].ravel().tolist()


@pytest.mark.slow
def test_every_function_of_a_robot_is_that_of_the_virtual_machine(robot):
    """All outputs, bit by bit, at a batch of random states with a single row of parameters; those
    of inner loops may round otherwise."""
    rng, names = np.random.default_rng(6), []
    for given in [*robot_functions(robot.geometry), *motion_functions(robot.geometry)]:
        if isinstance(given, ColumnFunction) or getattr(given, "side_by_side", 1) > 1:
            names.append(given.name())
            continue
        function = given.whole if isinstance(given, PartedFunction) else given
        pose = robot.home_pose + BOX * rng.uniform(-1, 1, (5, 6))
        sizes = [function.nnz_in(k) for k in range(function.n_in())]
        first = [pose] if sizes[0] == 6 else []
        inputs = [
            *first,
            *[
                rng.normal(size=(5, size)) if size == 6 else rng.uniform(size=(1, size))
                for size in sizes[len(first) :]
            ],
        ]
        found = robot.functions[function.name()](*inputs)
        for row in range(5):
            at = [
                part[row % len(part)].reshape(function.size_in(k)) for k, part in enumerate(inputs)
            ]
            expected = function.call([*map(ca.DM, at)])
            for ours, theirs in zip(found, expected, strict=True):
                rounding = 1e-12 * np.abs(theirs.full()).max() if function.name() in HOT else 0.0
                np.testing.assert_allclose(
                    ours[row], theirs.full(), 0.0, rounding, err_msg=function.name()
                )
                assert ours[row].shape == theirs.shape
        names.append(function.name())
    assert sorted(robot.functions) == sorted(names)


ANGLES = np.concatenate(
    [np.linspace(-10, 10, 20_001), np.linspace(-1e5, 1e5, 20_000), [0.0, 1e-9, -1e-300, np.nan]]
)
PLACES = np.random.default_rng(2).normal(size=(2, 40_000)) * 10 ** np.random.default_rng(3).uniform(
    -9, 9, (2, 40_000)
)
ON_AXES = np.array(
    [[0.0, 0.0, 1.0, -1.0, 1.0, -1.0, 1e-300], [1.0, -1.0, 0.0, 0.0, 1.0, -1.0, -1e300]]
)


def test_angles_in_inner_loops_are_those_of_the_c_library(own_cache):
    """Sines to a unit in the last place of one, arctangents to one of the angle."""
    hot = [
        ca.Function("turning", [X], [ca.sin(X), ca.cos(X)]),
        ca.Function("angle", [X, Y], [ca.atan2(X, Y)]),
    ]
    found = compiled_functions(b"angles", lambda: hot, ("turning", "angle"))
    for ours, theirs in zip(
        found["turning"](ANGLES[:, None]), (np.sin(ANGLES), np.cos(ANGLES)), strict=True
    ):
        np.testing.assert_allclose(ours[:, 0, 0], theirs, 0.0, 2.3e-16)
    across, along = np.hstack([PLACES, ON_AXES])
    (angles,) = found["angle"](across[:, None], along[:, None])
    np.testing.assert_allclose(angles[:, 0, 0], np.arctan2(across, along), 4.5e-16, 0.0)


def test_quotients_by_one_number_in_inner_loops_take_one_division(own_cache):
    quotients = ca.Function("f", [X, Y], [X / Y, (X + 1) / Y, 1 / Y, 2 / X])
    found = quickened(graph_of(quotients))
    assert sorted(node.operation for node in found.nodes if node.operation in ("DIV", "INV")) == [
        "DIV",
        "INV",
    ]
    ours = compiled_functions(b"quotients", lambda: [quotients], ("f",))["f"](
        np.array([[3.0]]), np.array([[7.0]])
    )
    np.testing.assert_allclose(np.ravel(ours), [3 / 7, 4 / 7, 1 / 7, 2 / 3], 4.5e-16, 0.0)


def test_sums_of_products_in_inner_loops_are_rounded_once(own_cache):
    """Against fractions, where the product alone would be rounded; either factor or the sum may be
    negative.
    """
    x, y, z = (ca.SX.sym(name) for name in "xyz")
    sums = ca.Function("f", [x, y, z], [x * y + z, z - x * y, x * y - z, z + x * x])
    assert [node.operation for node in quickened(graph_of(sums)).nodes].count("FMA") == 4
    given = np.random.default_rng(4).normal(size=(200, 3)) * [1.0, 1.0, 1e-9]
    found = compiled_functions(b"sums", lambda: [sums], ("f",))["f"](
        *(column[:, None] for column in given.T)
    )
    for row, (a, b, c) in enumerate(
        [[Fraction(value) for value in values] for values in given.tolist()]
    ):
        exact = [a * b + c, c - a * b, a * b - c, c + a * a]
        assert [float(part[row, 0, 0]) for part in found] == [float(one) for one in exact]


@pytest.mark.parametrize("width", [1, 8, 13])
def test_a_function_of_columns_is_that_of_the_virtual_machine_column_by_column(robot, width):
    """But for rounding, as far as it was asked for and to the end of that vector; what is behind
    stays.
    """
    given, rng = (
        slope_derivative(robot.layout, len(robot.coordinate_names)),
        np.random.default_rng(8),
    )
    inputs = [rng.normal(size=given.function.size_in(k)) for k in range(given.common)]
    rows = rng.normal(
        size=(
            sum(given.function.nnz_in(k) for k in range(given.common, given.function.n_in())),
            given.room,
        )
    )
    into = np.full(
        (sum(given.function.nnz_out(k) for k in range(given.function.n_out())), given.room), 7.0
    )
    # what is between is not read
    common = np.repeat(np.concatenate([part.ravel() for part in inputs]), given.apart)
    common[np.arange(len(common)) % given.apart > 0] = np.nan
    plain(call_columns_of)(robot.functions["slope_derivative"].address, common, rows, into, width)
    ends = np.cumsum(
        [given.function.nnz_in(k) for k in range(given.common, given.function.n_in())]
    )[:-1]
    last = -(-width // given.lanes) * given.lanes
    for column in range(last):
        expected = given.function.call(
            [*map(ca.DM, inputs), *map(ca.DM, np.split(rows[:, column], ends))]
        )
        expected = np.concatenate([part.full().ravel() for part in expected])
        np.testing.assert_allclose(into[:, column], expected, 1e-13, 1e-13 * np.abs(expected).max())
    assert (into[:, last:] == 7.0).all()


@kernel
def call_columns_of(address, common, rows, into, width):
    call_columns(address, common, rows, into, width)


@pytest.mark.parametrize("name", OPERATIONS)
def test_every_operation_is_that_of_the_virtual_machine_whatever_its_arguments(own_cache, name):
    """Bit by bit, signs of zeros included, on all pairs of special and of random numbers."""
    function, x, y = machine_function(name)
    found = compiled_functions(name.encode(), lambda: [function])["f"](x[:, None], y[:, None])[
        0
    ].ravel()
    check_bits(found, function(ca.DM(x).T, ca.DM(y).T).full().ravel())


@pytest.mark.parametrize("name", OPERATIONS)
def test_operations_in_lanes_are_those_one_by_one(own_cache, name):
    """Bit by bit as above, of three parts alike, and a fourth that is not and has the same
    operation inside; and for four sets of inputs side by side."""
    function, x, y = machine_function(name)
    z, (p, q, r) = np.roll(x, 5), (ca.SX.sym(name) for name in "pqr")
    alike = [function(first, second) for first, second in ((p, q), (q, r), (r, p))]
    parts = ca.Function(
        "parts", [p, q, r, ca.SX.sym("none", 0)], [*alike, ca.cos(function(q, p)) * r]
    )
    columns = [ca.SX.sym("column") for _ in range(4)]
    end = ca.Function("f", [p, q, r, *columns], [ca.vertcat(*columns)])
    given = PartedFunction(parts, end, np.zeros(0))
    assert sorted(group.lanes for group in lane_groups(graph_of(parts, np.zeros(0)))) == [
        (0, 1, 2),
        (3,),
    ]
    machine = compiled_functions(name.encode(), lambda: [given, given.beside(4, "four")])
    found, expected = (
        machine["f"](x[:, None], y[:, None], z[:, None])[0][..., 0],
        given.whole(*map(_row, (x, y, z))),
    )
    check_bits(found, expected.full().T)
    inputs, outputs = np.zeros((3, 4)), np.zeros((4, 4))
    four = machine["four"].bound_to(inputs, outputs)
    for some in np.split(np.arange(len(x) // 4 * 4), len(x) // 4):
        inputs[:] = x[some], y[some], z[some]
        four()
        check_bits(outputs, found[some].T)


def _row(values):
    return ca.DM(values).T


def machine_function(name):
    """A function of x and y with this operation in it, and all pairs of special and of random
    numbers.
    """
    code = next(code for code, known in NAMES.items() if known == name)
    ways = [
        ca.Function("f", [X, Y], [f()]) for f in (lambda: ca.SX.binary(code, X, Y), lambda: X**2.7)
    ]
    function = next(
        f for f in ways if code in [f.instruction_id(k) for k in range(f.n_instructions())]
    )
    values = np.array([*SPECIAL, *np.random.default_rng(1).normal(size=6)])
    return function, *(part.ravel() for part in np.meshgrid(values, values))


def check_bits(found, expected):
    np.testing.assert_array_equal(found, expected)
    numbers = ~np.isnan(expected)
    np.testing.assert_array_equal(np.signbit(found[numbers]), np.signbit(expected[numbers]))


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (
            ca.Function("odd", [X], [ca.erf(X)]),
            "odd: no machine code for the operation ERF; known: ACOS, ADD, ",
        ),
        (
            ca.Function("odd", [ca.MX.sym("x")], [ca.MX(1.0)]),
            "only SX functions .*: odd is MXFunction",
        ),
        (
            ca.Function("odd", [X], [ca.diag(ca.vertcat(X, X))]),
            "only dense matrices .*: odd has 2x2,2nz",
        ),
        (
            ca.Function("odd", [ca.SX.sym("x", ca.Sparsity.upper(2))], [ca.SX(1.0)]),
            "odd has 2x2,3nz",
        ),
    ],
)
def test_what_cannot_be_translated_is_named(own_cache, function, words):
    with pytest.raises(DynamicsError, match=words):
        compiled_functions(b"odd", lambda: [function])
    assert not own_cache.exists()


def test_code_is_compiled_once_per_content(own_cache):
    """The second request builds nothing; other content is another file; nobody else may read or
    write them.
    """
    build = Mock(side_effect=_square)
    assert square(build) == square(build) == [9.0, 16.0]
    build.assert_called_once()
    square(content=b"other")
    files = list(own_cache.iterdir())
    assert len(files) == 2
    assert {file.stat().st_mode & 0o777 for file in files} == {0o600}


@pytest.mark.slow
def test_the_digest_has_every_file_that_writes_the_functions_of_a_robot(monkeypatch):
    """Python's own record of the calls says which files write the expressions."""
    robot = load_robot("rrr3").with_full_bodies(["all"])
    geometry = robot.with_passive_friction(["link_joint.viscous"]).geometry
    called = set()
    sys.setprofile(lambda frame, *_: called.add(frame.f_code.co_filename))
    try:
        _ = *robot_functions(geometry), *motion_functions(geometry), closure_function(geometry)
    finally:
        sys.setprofile(None)
    read = Mock(return_value=b"")
    monkeypatch.setattr(Path, "read_bytes", lambda path: read(str(path)))
    machine_code._package_digest.__wrapped__()
    folder = str(Path(machine_code.__file__).parents[1])
    written = {path for path in called if path.startswith(folder)}
    assert written
    assert written <= {call.args[0] for call in read.call_args_list}


@pytest.mark.slow
def test_two_processes_that_compile_at_once_leave_one_whole_file(own_cache):
    """Both end well, and no temporary file is left behind."""
    load = (
        "import casadi as ca, numpy as np\nfrom dynamics.compiled.machine_code import "
        "compiled_functions\n"
    )
    command = [
        sys.executable,
        "-c",
        "\n".join([load, getsource(_square), getsource(square), "print(square())"]),
    ]
    run = {"stdout": subprocess.PIPE, "text": True, "cwd": Path(__file__).parents[2]}
    processes = [subprocess.Popen(command, **run) for _ in range(2)]
    assert [process.communicate(timeout=60)[0] for process in processes] == ["[9.0, 16.0]\n"] * 2
    (file,) = own_cache.iterdir()
    assert load_object(file.name)


SPOILED = {
    "cut": lambda file, other: file.write_bytes(file.read_bytes()[:-1]),
    "empty": lambda file, other: file.write_bytes(b""),
    "of another key": lambda file, other: file.write_bytes(other.read_bytes()),
    "writable by a group": lambda file, other: file.chmod(0o620),
    "writable by all": lambda file, other: file.chmod(0o666),
}


@pytest.mark.parametrize("way", SPOILED)
def test_a_file_that_is_damaged_or_may_be_foreign_is_made_anew(own_cache, way):
    build = Mock(side_effect=_square)
    square()
    (file,) = own_cache.iterdir()
    square(content=b"other")
    SPOILED[way](file, next(other for other in own_cache.iterdir() if other != file))
    assert square(build) == square(build) == [9.0, 16.0]
    build.assert_called_once()
    assert file.stat().st_mode & 0o777 == 0o600


def test_no_bit_of_a_file_may_change_nor_its_owner(own_cache, monkeypatch):
    square()
    (file,) = own_cache.iterdir()
    whole, owner = file.read_bytes(), os.geteuid()
    for place in range(len(whole)):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        assert load_object(file.name) is None
    file.write_bytes(whole)
    assert load_object(file.name)
    monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    assert load_object(file.name) is None


def test_code_that_was_not_used_for_two_months_is_removed_and_other_files_stay(
    own_cache, monkeypatch
):
    monkeypatch.setattr(object_files, "_remove_unused", object_files._remove_unused.__wrapped__)
    save_object("used.robot", b"used")
    for name in ("unused.robot", "broken_off.half", "new.kernel", "notes.txt"):
        (own_cache / name).write_bytes(b"")
    long_ago = time.time() - 61 * 24 * 3600
    for name in ("used.robot", "unused.robot", "broken_off.half", "notes.txt"):
        os.utime(own_cache / name, (long_ago, long_ago))
    assert load_object("used.robot") == b"used"
    save_object("next.robot", b"next")
    assert {path.name for path in own_cache.iterdir()} == {
        "used.robot",
        "new.kernel",
        "notes.txt",
        "next.robot",
    }


def _twice(x):
    return 2 * x


def test_kernels_are_kept_in_the_same_files(own_cache):
    """Found again by another of the same lines; made anew where others could have written it."""
    assert entry(_twice)(3) == 6
    (file,) = own_cache.iterdir()
    found = entry(_twice)
    assert found(4) == 8
    assert sum(found.stats.cache_hits.values()) == 1
    file.chmod(0o666)
    anew = entry(_twice)
    assert anew(5) == 10
    assert sum(anew.stats.cache_misses.values()) == 1
    assert file.stat().st_mode & 0o777 == 0o600


@pytest.mark.slow
def test_where_numba_is_switched_off_the_plain_lines_run(loop):
    code = (
        "from tests.dynamics.conftest import Loop; import dynamics; robot = "
        "dynamics.load_robot('rss6');"
        "run = Loop(robot, robot.parameter_sets['truth'].vector).run(3); "
        "print(run.pose[-1].tolist())"
    )
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    folder = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    assert eval(done.stdout) == loop.run(3).pose[-1].tolist()


def test_everything_works_in_memory_after_one_warning_where_nothing_can_be_written(
    tmp_path, monkeypatch
):
    """Each function is compiled whenever it is asked for; that is said in one line, and only
    once."""
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("CMMSIM_CACHE", str(tmp_path / "file" / "no_folder"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert square() == square(content=b"other") == [9.0, 16.0]
    assert [warning.category for warning in caught] == [CacheWarning]
    said = str(caught[0].message)
    assert "\n" not in said
    assert all(words in said for words in ("no_folder", "Not a directory", "CMMSIM_CACHE"))


SYMBOLS = """
import sys
from numba import typeof
from numba.core.itanium_mangler import mangle_type_or_value
import dynamics.compiled.kernel
from dynamics.closed_loop.run_memory import empty_memory
from dynamics.closed_loop.problem import (Sizes,)
for number in map(int, sys.argv[1:]):
    print(number, *[mangle_type_or_value(typeof(part)) for part in empty_memory(Sizes(number,
    number, 10 * number))])
"""


@pytest.mark.slow
def test_kernels_of_robots_of_other_sizes_have_other_symbols_and_the_same_in_every_process():
    """Whatever was compiled before: kernels from the cache, of several processes, stand beside each
    other.
    """
    first, second = (
        subprocess.run(
            [sys.executable, "-c", SYMBOLS, *order], capture_output=True, text=True, check=True
        ).stdout
        for order in (("6", "3"), ("3", "6"))
    )
    assert sorted(first.splitlines()) == sorted(second.splitlines())
    one, other = (line.split()[1:] for line in first.splitlines())
    assert not set(one) & set(other)
