"""Functions of a robot's geometry: compiled functions, and CasADi functions for users."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property, lru_cache

import casadi as ca

from dynamics.compiled.machine_code import Functions, MachineFunction, compiled_functions
from dynamics.geometry import AnyGeometry, MovableGeometry, RobotGeometry
from dynamics.rigid_body.equation_of_motion import motion_functions
from dynamics.rigid_body.virtual_work import robot_functions

# Names of the functions that inner loops evaluate, and that are therefore optimised.
HOT = (
    "equation_of_motion",
    "free_acceleration",
    "response",
    "motion_derivatives",
    "rate_map_derivative",
    "stage_derivatives",
    "stop_derivatives",
    "slope_derivative",
    "forward_dynamics",
    "motion_in_lanes",
    "acceleration_in_lanes",
    "servo_jacobian",
)

# Names of the inputs and of the outputs of the functions that `Robot.casadi` returns.
CASADI = {
    "inverse_kinematics": ("pose", "theta reach_margin"),
    "joint_jacobian": ("pose", "jacobian"),
    "pose_jacobian": ("pose", "jacobian"),
    "mass_matrix": ("pose parameters", "mass_matrix"),
    "coriolis_matrix": ("pose twist parameters", "coriolis_matrix"),
    "gravity_wrench": ("pose parameters", "wrench"),
    "friction_wrench": ("pose twist parameters", "wrench"),
    "regressor": ("pose twist twist_dot", "regressor"),
    "inverse_dynamics": ("pose twist twist_dot parameters", "torque"),
    "forward_dynamics": ("pose twist torque parameters", "twist_dot"),
}


class CompiledFunctions(Mapping[str, MachineFunction]):
    """Compiled functions of a robot by name.

    The functions of the integrator of the closed loop, `motion`, take four fifths of the time of
    compiling. They are compiled when one of them is first asked for.
    """

    def __init__(
        self,
        others: Functions,
        compile_motion: Callable[[], Functions],
    ) -> None:
        self.others = others
        self._compile_motion = compile_motion

    @cached_property
    def motion(self) -> Functions:
        """Functions of the integrator."""
        return self._compile_motion()

    def __getitem__(self, name: str) -> MachineFunction:
        return self.others[name] if name in self.others else self.motion[name]

    def __iter__(self) -> Iterator[str]:
        yield from self.others
        yield from self.motion

    def __len__(self) -> int:
        return len(self.others) + len(self.motion)


@lru_cache(maxsize=16)
def own_functions(geometry: RobotGeometry) -> CompiledFunctions:
    """Compiled functions of a geometry, shared by all robots with this geometry.

    Robots do not store these functions, and can thus be pickled.
    """
    return _compiled(geometry, geometry.digest)


@lru_cache(maxsize=4)
def _movable_functions(nominal: RobotGeometry) -> CompiledFunctions:
    """Compiled functions for all geometries near a nominal one, with deviations as last input."""
    return _compiled(MovableGeometry(nominal), b"movable" + nominal.digest)


def _compiled(geometry: AnyGeometry, key: bytes) -> CompiledFunctions:
    return CompiledFunctions(
        compiled_functions(key, lambda: [*robot_functions(geometry)], HOT),
        lambda: compiled_functions(b"motion" + key, lambda: motion_functions(geometry), HOT),
    )


@lru_cache(maxsize=64)
def nearby_functions(nominal: RobotGeometry, geometry: RobotGeometry) -> CompiledFunctions:
    """Compiled functions of a geometry near a nominal one. Their machine code is shared."""
    deviations = geometry.deviations_from(nominal)
    shared = _movable_functions(nominal)

    def moved(functions: Functions) -> dict[str, MachineFunction]:
        return {name: replace(each, constants=deviations) for name, each in functions.items()}

    return CompiledFunctions(moved(shared.others), lambda: moved(shared.motion))


@lru_cache(maxsize=4)
def _functions_by_name(geometry: RobotGeometry) -> dict[str, ca.Function]:
    """CasADi functions of a geometry. They are built together, which takes a second or two."""
    return {function.name(): function for function in robot_functions(geometry)}


@lru_cache(maxsize=64)
def casadi_function(geometry: RobotGeometry, name: str) -> ca.Function:
    """CasADi function of a geometry, with named inputs and outputs as in `CASADI`."""
    function = _functions_by_name(geometry)[name]
    inputs, outputs = (names.split() for names in CASADI[name])
    symbols = [ca.SX.sym(symbol_name, function.size1_in(k)) for k, symbol_name in enumerate(inputs)]
    return ca.Function(name, symbols, function.call(symbols), inputs, outputs)
