"""Sections of a scenario about the robot: the true plant, and the model of it."""

from typing import Literal, get_args

from pydantic import Field, field_validator, model_validator

from dynamics.checks import Gain, check_inertia_forms, within
from identify.scenario.section import Section, quantity

# Friction laws of the joints. ``coulomb_viscous`` is the exact law with stick and slip (eq. 24),
# ``smoothed`` has tanh(theta_dot / v_s) instead of the sign, and ``stribeck`` is exact with a
# breakaway torque above the Coulomb torque.
FrictionName = Literal["coulomb_viscous", "smoothed", "stribeck"]

# Constants that each friction law needs, each with its possible keys. A law has no other constants.
FRICTION_CONSTANTS: dict[str, tuple[tuple[str, ...], ...]] = {
    "coulomb_viscous": (),
    "smoothed": (("smoothing_velocity_rad_s", "smoothing_velocity_m_s"),),
    "stribeck": (("static_ratio",), ("stribeck_velocity_rad_s", "stribeck_velocity_m_s")),
}

InertiaForm = Literal["centred", "full"]

DriveName = Literal["pid", "pd", "pi", "cascade", "pid_filtered"]
"""Laws by which drives turn joint commands into torques, see `closed_loop.drives`.

They are the paper's PID, parts of it, a P-PI cascade, and a PID with a filtered rate.
"""

FILTERED: DriveName = "pid_filtered"

LARGEST_ZERO = 0.1  # largest error of the zero of a joint, rad or m
AUTO = "auto"  # drive of a model whose law is determined from the record


def check_filter(drive: str, seconds: float | None) -> None:
    """Raise ValueError unless the filtered drive, and no other, has a filter's time constant."""
    if (drive == FILTERED) != (seconds is not None):
        raise ValueError(
            f"drive = {drive!r} with derivative_filter_s = {seconds}: the law {FILTERED} needs "
            "it, and no other has it"
        )


# Gains that each law of the drives uses.
DRIVE_GAINS: dict[str, tuple[str, ...]] = {
    "pid": ("lp", "li", "ld"),
    "pd": ("lp", "ld"),
    "pi": ("lp", "li"),
    "cascade": ("lp", "li", "ld"),
    "pid_filtered": ("lp", "li", "ld"),
}


class _Side(Section):
    """Settings that the plant and its model both have."""

    inertia: InertiaForm | dict[str, InertiaForm] | None = Field(
        None,
        description="full: bodies have ten inertial parameters; centred: four; or a table by body "
        'or kind of body, as { platform = "full" }; by default as the robot file says',
    )
    gains: Literal["shared", "each"] = Field(
        "shared",
        description="shared: all joints have the same gains lp, li, ld; each: every joint has its "
        "own, such as joint3.lp",
    )
    passive_friction: list[str] | None = Field(
        None,
        description="parameters of the friction of passive joints, each joint named by the body "
        'outwards from it; ["link_joint.viscous", "platform_joint.coulomb"] of all legs, or '
        '["link3_joint.viscous"] of one; by default those of the robot file',
    )
    friction: FrictionName = Field("coulomb_viscous", description="friction law of the joints")
    smoothing_velocity_rad_s: float | None = quantity(
        None, "rad/s", "velocity v_s over which the law smoothed smooths the sign", gt=0
    )
    smoothing_velocity_m_s: float | None = quantity(
        None, "m/s", "velocity v_s of the law smoothed, for actuators that slide", gt=0
    )
    static_ratio: float | None = quantity(
        None, "1", "ratio of breakaway to Coulomb torque of the law stribeck", ge=1, le=1e3
    )
    stribeck_velocity_rad_s: float | None = quantity(
        None, "rad/s", "velocity over which the breakaway torque falls to the Coulomb torque", gt=0
    )
    stribeck_velocity_m_s: float | None = quantity(
        None, "m/s", "velocity over which the breakaway force falls to the Coulomb force", gt=0
    )

    @field_validator("inertia", mode="before")
    @classmethod
    def _forms_are_known(cls, value: object) -> object:
        return None if value is None else check_inertia_forms(value)

    @model_validator(mode="after")
    def _constants_fit_the_law(self) -> "_Side":
        for law, constants in FRICTION_CONSTANTS.items():
            for keys in constants:
                # Keys of turning and of sliding actuators exclude each other.
                given = {name: value for name in keys if (value := getattr(self, name)) is not None}
                if (law == self.friction) != (len(given) == 1):
                    text = " and ".join(
                        f"{name} = {value}" for name, value in (given or {keys[0]: None}).items()
                    )
                    needed = " and ".join(" or ".join(names) for names in constants)
                    raise ValueError(
                        f"friction = {self.friction!r} with {text}: the law {law} needs {needed}, "
                        "and no other law has them"
                    )
        return self


class Plant(_Side):
    """Simulated real robot. Each possible difference from the estimator's model is a setting.

    With the largest geometry error, all of 100 robots reach the whole box of +-10 mm and +-0.04
    rad. With twice that error, one does not. With the largest stiffness, a run differs from a run
    with rigid joints by 0.03 um, and takes 1000 steps per frame.
    """

    parameters: str = Field(
        "truth", description="parameter set of the robot file with which the true robot moves"
    )
    values: dict[str, float] = Field(
        {},
        description="true values of single parameters, instead of those of the parameter set, SI; "
        "a stated first moment or product of inertia makes a body full, and stated friction of a "
        "passive joint exists; "
        '{ "platform.mcz" = 0.7 }, or with gains = "each" { "joint3.lp" = 11 }',
    )
    drive: DriveName = Field(
        "pid", description="law of the drives; pid is the paper's, cascade is P-PI"
    )
    derivative_filter_s: float | None = quantity(
        None, "s", "time constant of the drive pid_filtered", gt=0, le=1
    )
    drive_gains: dict[str, float] = Field(
        {},
        description="gains of the drives, instead of those of the parameter set, in the same "
        "units; { lp = 10.5, li = 30.0, ld = 0.3 }",
    )
    joint_zero_error_rad: float | list[float] = Field(
        0.0,
        description="what each joint reads too little, rad: a list with one value per joint, or "
        "the standard deviation of values that are drawn with geometry_seed",
        json_schema_extra={"unit": "rad"},
    )
    joint_zero_error_m: float | list[float] = Field(
        0.0,
        description="what each sliding joint reads too little, m, as joint_zero_error_rad",
        json_schema_extra={"unit": "m"},
    )
    friction_offset_N_m: float | list[float] = Field(
        0.0,
        description="half the difference of the Coulomb friction of each joint in its positive and "
        "its negative direction, N m: one value, or a list with one per joint",
        json_schema_extra={"unit": "N m"},
    )
    friction_offset_N: float | list[float] = Field(
        0.0,
        description="half the difference of the Coulomb friction of each sliding joint in both "
        "directions, N, as friction_offset_N_m",
        json_schema_extra={"unit": "N"},
    )
    command_scale: float = quantity(
        1.0, "1", "ratio of the commands that the drives receive to those sent", ge=0.5, le=2
    )
    command_quantum_rad: float | None = quantity(
        None, "rad", "steps to which the drives round the commands", gt=0, le=0.1
    )
    command_quantum_m: float | None = quantity(
        None, "m", "steps to which sliding drives round the commands", gt=0, le=0.01
    )
    command_limits_rad: list[float] | None = Field(
        None,
        description="lowest and highest command that the drives take, rad, equal for all "
        "joints; commands beyond are clipped",
        min_length=2,
        max_length=2,
        json_schema_extra={"unit": "rad"},
    )
    command_limits_m: list[float] | None = Field(
        None,
        description="lowest and highest command that the drives of actuators that slide take, m",
        min_length=2,
        max_length=2,
        json_schema_extra={"unit": "m"},
    )
    steps_per_frame: int = quantity(
        16, "1", "integration steps per frame; elastic joints take more", ge=1, le=10_000
    )
    geometry_error_m: float = quantity(
        0.0,
        "m",
        "standard deviation of each coordinate of the joint centres from the robot file",
        ge=0,
        le=1e-3,
    )
    length_error_m: float = quantity(
        0.0,
        "m",
        "standard deviation of each length of the legs from the robot file",
        ge=0,
        le=1e-3,
    )
    axis_error_rad: float = quantity(
        0.0,
        "rad",
        "standard deviation of both angles by which an axis of a leg is turned",
        ge=0,
        le=1e-2,
    )
    geometry_seed: int = quantity(0, "1", "seed of the drawn geometry and joint zeros", ge=0)
    joint_stiffness_N_m_rad: float | None = quantity(
        None,
        "N m/rad",
        "stiffness of a spring between motor and driven body, which makes the joint elastic",
        gt=0,
        le=1e6,
    )
    joint_stiffness_N_m: float | None = quantity(
        None, "N/m", "stiffness of the spring in an elastic joint that slides", gt=0, le=1e9
    )
    joint_damping_N_m_s_rad: float = quantity(
        0.05, "N m s/rad", "damping of the spring between motor and driven body", ge=0
    )
    joint_damping_N_s_m: float = quantity(
        50.0, "N s/m", "damping of the spring in an elastic joint that slides", ge=0
    )
    motor_inertia_kg_m2: float = quantity(
        3e-4, "kg m2", "part of the driven body's inertia on the motor's side of the spring", gt=0
    )
    motor_mass_kg: float = quantity(
        0.3,
        "kg",
        "part of the driven body's mass on the motor's side of the spring, if it slides",
        gt=0,
    )

    @property
    def drive_law(self) -> DriveName:
        """Law of the drives."""
        return self.drive

    @field_validator("command_limits_rad", "command_limits_m")
    @classmethod
    def _limits_are_in_order(cls, limits: list[float] | None) -> list[float] | None:
        if limits is not None and not limits[0] < limits[1]:
            raise ValueError(f"the lowest command {limits[0]:g} is not below the highest")
        return limits

    @field_validator("joint_zero_error_rad", "joint_zero_error_m")
    @classmethod
    def _zeros_are_small(cls, error: float | list[float]) -> float | list[float]:
        for value in error if isinstance(error, list) else [error]:
            least = 0.0 if error is value else -LARGEST_ZERO
            if not least <= value <= LARGEST_ZERO:
                raise ValueError(f"{value:g} is not from {least:g} to {LARGEST_ZERO:g}")
        return error

    @model_validator(mode="after")
    def _gains_are_those_of_the_law(self) -> "Plant":
        check_filter(self.drive, self.derivative_filter_s)
        reads = DRIVE_GAINS[self.drive]
        for name, value in self.drive_gains.items():
            if name not in reads or not value > 0:
                raise ValueError(
                    f"drive_gains.{name} = {value:g}: the law {self.drive} has the gains "
                    f"{', '.join(reads)}, all > 0"
                )
            try:
                within(Gain).check(value)
            except ValueError as error:
                raise ValueError(f"drive_gains.{name}: {error}") from None
        return self


class Model(_Side):
    """Estimator's model of the robot."""

    start_parameters: str = Field(
        "guess", description="parameter set of the robot file that is the initial guess"
    )
    drive: Literal["pid", "pd", "pi", "cascade", "pid_filtered", "auto"] = Field(
        "pid", description="law of the drives; auto takes the most probable one of the record"
    )
    derivative_filter_s: float | None = quantity(
        None,
        "s",
        "time constant of the drive pid_filtered; auto considers this drive only if it is stated",
        gt=0,
        le=1,
    )
    joint_zero_std_rad: float = quantity(
        0.0,
        "rad",
        "standard deviation of the zero of each joint, which is estimated beside the parameters; a "
        "calibrated geometry states its own",
        ge=0,
        le=0.1,
    )
    joint_zero_std_m: float = quantity(
        0.0,
        "m",
        "standard deviation of the zero of each sliding joint, estimated beside the parameters",
        ge=0,
        le=0.1,
    )
    command_scale_std: float = quantity(
        0.0,
        "1",
        "standard deviation of the ratio of the commands that the drives receive to those logged, "
        "which is estimated beside the parameters",
        ge=0,
        le=0.1,
    )
    friction_offset_std_N_m: float | None = quantity(
        None,
        "N m",
        "standard deviation of half the difference of the Coulomb friction of each joint in both "
        "directions, which is estimated beside the parameters",
        gt=0,
    )
    friction_offset_std_N: float | None = quantity(
        None,
        "N",
        "standard deviation of half the difference of the Coulomb friction of each sliding joint "
        "in both directions, which is estimated beside the parameters",
        gt=0,
    )
    static_ratio_std: float = quantity(
        0.0, "1", "standard deviation of static_ratio, estimated beside the parameters", ge=0, le=9
    )
    stribeck_velocity_std_rad_s: float | None = quantity(
        None, "rad/s", "standard deviation of stribeck_velocity_rad_s", gt=0
    )
    stribeck_velocity_std_m_s: float | None = quantity(
        None, "m/s", "standard deviation of stribeck_velocity_m_s", gt=0
    )
    centre_std: float | None = quantity(
        None,
        "1",
        "standard deviation of each coordinate of the centre of mass of a centred body, as a share "
        "of its length; by default that of the robot file, which is 0 for the built-in robots",
        ge=0,
        le=1,
    )
    product_std: float | None = quantity(
        None,
        "1",
        "standard deviation of each product of inertia of a centred body, as a share of its mean "
        "moment of inertia; by default that of the robot file, which is 0 for the built-in robots",
        ge=0,
        le=1,
    )
    passive_viscous_std_N_m_s_rad: float | None = quantity(
        None,
        "N m s/rad",
        "standard deviation of the viscous friction of passive joints without such a parameter; by "
        "default that of the robot file, which is 0 for the built-in robots",
        ge=0,
        le=1e3,
    )
    steps_per_frame: int = quantity(
        4,
        "1",
        "least integration steps per frame; a robot with faster motion has more",
        ge=1,
        le=10_000,
    )

    @property
    def drive_law(self) -> DriveName:
        """Law of the drives. The law auto stands for the paper's PID until a record settles it."""
        return "pid" if self.drive == "auto" else self.drive

    def with_drive(self, law: DriveName) -> "Model":
        """Return a copy with an identified law of the drives, if the model leaves the law open."""
        if self.drive != AUTO:
            return self
        filter_time = self.derivative_filter_s if law == FILTERED else None
        return self.model_copy(update={"drive": law, "derivative_filter_s": filter_time})

    @property
    def drives_considered(self) -> tuple[DriveName, ...]:
        """Laws of the drives from which `auto` selects."""
        return tuple(
            law for law in get_args(DriveName) if law != FILTERED or self.derivative_filter_s
        )

    @model_validator(mode="after")
    def _filter_fits_the_law(self) -> "Model":
        if self.drive != AUTO:
            check_filter(self.drive, self.derivative_filter_s)
        return self
