"""A scenario: everything that decides a synthetic experiment, read from TOML and checked as a whole.

Each field states its unit; an error names the key, the value, the unit and, for a wrong name, the valid names.
"""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from identify.errors import ScenarioError
from identify.record.filtering import padding_samples
from identify.scenario_text import one_line, to_toml
from identify.sensor_timing import NAMES, by_dotted_key, check_delay, sensor_timing, timing_in_file

BUILT_IN = Path(__file__).parent / "scenarios"

FrictionName = Literal["coulomb_viscous", "smoothed", "stribeck"]
"""``coulomb_viscous``: the exact law with stick and slip (eq. 24); ``smoothed``: tanh(theta_dot / v_s);
``stribeck``: exact, with a breakaway torque above the Coulomb torque."""

FRICTION_CONSTANTS = {
    "coulomb_viscous": (),
    "smoothed": ("smoothing_velocity_rad_s",),
    "stribeck": ("static_ratio", "stribeck_velocity_rad_s"),
}
"""The constants each law needs; it takes no others."""


def _quantity(default: Any, unit: str, what: str, **limits: Any) -> Any:
    return Field(default, description=what, json_schema_extra={"unit": unit}, **limits)


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Timing(_Section):
    """Sampling of the pose sensor and of the visual servo.

    All but the hold is the sensor file's where a scenario does not state it. A measured pose is that in the middle of
    its exposure, which is the time of its frame.
    """

    frame_rate_hz: float = _quantity(60.0, "Hz", "stereo frames a second; the servo acts once a frame", gt=0, le=2000)
    exposure_s: float = _quantity(0.0, "s", "time in which a picture gathers light; 0 is an instant", ge=0, le=1)
    latency_s: float = _quantity(0.0, "s", "mean delay from the middle of the exposure to the command", ge=0, le=1)
    latency_jitter_s: float = _quantity(0.0, "s", "standard deviation of the latency between frames", ge=0, le=1)
    dropout: float = _quantity(0.0, "1", "probability that a frame is lost on its way", ge=0, le=1)
    hold: Literal["zero", "linear"] = Field("zero", description="joint command between two frames")

    @property
    def frame_period_s(self) -> float:
        """Time between two frames [s]."""
        return 1.0 / self.frame_rate_hz

    def frames(self, duration_s: float) -> int:
        """Number of frame periods in ``duration_s``."""
        return round(duration_s * self.frame_rate_hz)


class Servo(_Section):
    """Gains of the outer visual servo (eq. 30)."""

    kp: float = _quantity(0.3, "1", "proportional gain", ge=0)
    kd: float = _quantity(0.001, "s", "derivative gain", ge=0)
    ki: float = _quantity(2.4, "1/s", "integral gain", ge=0)


class _Friction(_Section):
    friction: FrictionName = Field("coulomb_viscous", description="friction law of the joints")
    smoothing_velocity_rad_s: float | None = _quantity(None, "rad/s", "v_s of the law smoothed", gt=0)
    static_ratio: float | None = _quantity(None, "1", "breakaway over Coulomb torque of the law stribeck", ge=1)
    stribeck_velocity_rad_s: float | None = _quantity(None, "rad/s", "velocity at which the excess fades", gt=0)

    @model_validator(mode="after")
    def _constants_fit_the_law(self) -> "_Friction":
        for law, constants in FRICTION_CONSTANTS.items():
            for name in constants:
                if (law == self.friction) != (getattr(self, name) is not None):
                    raise ValueError(
                        f"friction = {self.friction!r} with {name} = {getattr(self, name)}: the law {law} needs "
                        f"{' and '.join(constants)}, and no other law has them"
                    )
        return self


class Plant(_Friction):
    """The simulated real robot. Each way in which it may differ from any model of the estimator is a switch.

    At the largest geometry error all of 100 robots reach the whole box of +-10 mm and +-0.04 rad, at twice that one
    does not. At the largest stiffness a run differs from that of rigid joints by 0.03 um, and takes 1000 steps a frame.
    """

    parameters: str = Field("identified", description="named parameter set of the robot file, the truth")
    steps_per_frame: int = _quantity(16, "1", "integration steps a frame; elastic joints take more", ge=1, le=10_000)
    geometry_error_m: float = _quantity(
        0.0, "m", "standard deviation of each coordinate of the joint centres from the robot file's", ge=0, le=1e-3
    )
    geometry_seed: int = _quantity(0, "1", "which of the robots with such errors", ge=0)
    joint_stiffness_N_m_rad: float | None = _quantity(
        None, "N m/rad", "of a spring between motor and crank, makes the joints elastic", gt=0, le=1e6
    )
    joint_damping_N_m_s_rad: float = _quantity(0.05, "N m s/rad", "damping of that spring", ge=0)
    motor_inertia_kg_m2: float = _quantity(3e-4, "kg m2", "share of a crank's inertia before that spring", gt=0)


class Model(_Friction):
    """The estimator's model of the robot."""

    start_parameters: str = Field("initial", description="named parameter set of the robot file, the starting guess")
    steps_per_frame: int = _quantity(4, "1", "integration steps a frame", ge=1, le=10_000)


class Excitation(_Section):
    """The exciting trajectory (eq. 37) and its optimisation (eq. 39)."""

    fundamental_hz: float = _quantity(0.1, "Hz", "fundamental frequency f0", gt=0)
    harmonics: int = _quantity(5, "1", "number of harmonics n", ge=2, le=100)
    duration_s: float = _quantity(20.0, "s", "length of the excitation run", gt=0, le=3600)
    position_amplitude_m: float = _quantity(0.010, "m", "largest distance from home in x, y and z", gt=0)
    orientation_amplitude_rad: float = _quantity(0.04, "rad", "largest angle from home in each axis", gt=0, lt=1.5)
    travel_margin_rad: float = _quantity(0.10, "rad", "distance kept from the travel limit of the cranks", ge=0)
    candidates: int = _quantity(
        64, "1", "random trajectories: the best is chosen, is where a search begins, or they evolve", ge=1, le=100_000
    )
    method: Literal["random", "evolutionary", "gradient"] = Field(
        "random", description="best random trajectory, differential evolution (the paper's kind), or IPOPT"
    )
    criterion: Literal["observability", "information"] = Field(
        "observability", description="eq. 39, or D-optimality of the output error's information"
    )
    max_joint_velocity_rad_s: float = _quantity(2.0, "rad/s", "largest velocity of a crank", gt=0)
    generations: int = _quantity(324, "1", "generations of the evolutionary method (the paper: 324)", ge=1, le=100_000)


class Filter(_Section):
    """Zero-phase Butterworth filter of the measured poses."""

    order: int = _quantity(8, "1", "order of the filter, applied forward and reverse", ge=1, le=20)
    cutoff_hz: float = _quantity(10.0, "Hz", "cutoff frequency", gt=0)


class PriorValue(_Section):
    """What is known of a parameter before the experiment, in its SI unit."""

    value: float = _quantity(..., "SI", "expected value", ge=0)
    std: float = _quantity(..., "SI", "its standard deviation", gt=0)


class Identification(_Section):
    """Output-error estimation and its stop criteria (eq. 35)."""

    method: Literal["closed_loop", "command_driven"] = Field(
        "closed_loop", description="the model closes its own loop (the paper), or gets the logged commands"
    )
    scale_anchor: Literal["platform_mass", "joint_gain", "payload", "prior"] = Field(
        "platform_mass", description="what fixes the overall scale of the parameters; payload records a second run"
    )
    anchor_std: float | None = _quantity(None, "unit of the anchor", "standard deviation of the anchor", gt=0)
    start_std: float = _quantity(1.0, "1", "standard deviation of the starting guess, relative to each value", gt=0)
    prior: dict[str, PriorValue] = Field(
        {}, description="parameters known better than the starting guess: { name = { value, std } }"
    )
    physical_consistency: bool = Field(
        False, description="only masses and moments of inertia that a rigid body can have (the paper's have others)"
    )
    max_iterations: int = _quantity(30, "1", "iterations at most", ge=1, le=1000)
    cost_tolerance: float = _quantity(1e-6, "1", "tol1 of eq. 35, relative change of the cost", gt=0, lt=1)
    parameter_tolerance: float = _quantity(1e-3, "1", "tol2 of eq. 35, relative change of a parameter", gt=0, lt=1)
    qr_threshold: float = _quantity(1e-3, "1", "entries of R below it count as zero in base_rank (section 4.2)", gt=0)


class Payload(_Section):
    """The known load that the platform carries in the second run, where the scale anchor is a payload."""

    mass_kg: float = _quantity(8.0, "kg", "mass, its centre in the origin of the platform frame", gt=0)
    Ixx_kg_m2: float = _quantity(0.02, "kg m2", "moment of inertia about the platform's x axis", ge=0)
    Iyy_kg_m2: float = _quantity(0.02, "kg m2", "moment of inertia about the platform's y axis", ge=0)
    Izz_kg_m2: float = _quantity(0.04, "kg m2", "moment of inertia about the platform's z axis", ge=0)


class Validation(_Section):
    """Unseen trajectories on which the identified model is judged."""

    count: int = _quantity(10, "1", "number of unseen trajectories", ge=1, le=1000)
    duration_s: float = _quantity(10.0, "s", "length of each", gt=0, le=3600)


class Scenario(_Section):
    """A whole synthetic experiment; load one with :func:`load_scenario`."""

    name: str = Field(description="short name, used for folders", pattern=r"^[\w.-]+$")
    description: str = ""
    robot: str = Field("rss6", description="built-in robot or path of a robot file")
    sensor: str = Field("ctrack780", description="built-in sensor or path of a sensor file")
    sensor_note: str = Field("", description="what the sensor's file says about its own figures")
    sensor_changes: dict[str, Any] = Field({}, description="entries that hold instead of the sensor file's")
    renderer: Literal["pyrender", "analytic", "auto"] = Field(
        "pyrender", description="what draws the images; analytic needs no OpenGL, auto takes it where OpenGL is missing"
    )
    pose_method: Literal["registration", "planes"] = "registration"
    timing: Timing = Timing()
    servo: Servo = Servo()
    plant: Plant = Plant()
    model: Model = Model()
    excitation: Excitation = Excitation()
    filter: Filter = Filter()
    identification: Identification = Identification()
    payload: Payload = Payload()
    validation: Validation = Validation()

    @field_validator("sensor_changes")
    @classmethod
    def _by_dotted_key(cls, changes: dict[str, Any]) -> dict[str, Any]:
        return by_dotted_key(changes)

    @model_validator(mode="after")
    def _fits_together(self) -> "Scenario":
        self._complete_from_the_sensor()
        check_delay(sensor_timing(self.timing.model_dump()))
        self._check_filter()
        self._check_excitation_fits_the_filter()
        self._check_whole_frames("excitation.duration_s", self.excitation.duration_s)
        self._check_whole_frames("validation.duration_s", self.validation.duration_s)
        return self

    def _complete_from_the_sensor(self) -> None:
        """Fill in the timing and the note that the scenario leaves to its sensor.

        They do not count as set: with another sensor they are taken from that one.
        """
        stated = self.timing.model_fields_set
        if stated.issuperset(NAMES) and "sensor_note" in self.model_fields_set and not self.sensor_changes:
            return
        in_file, note = timing_in_file(self.sensor, self.sensor_changes)
        own = {name: getattr(self.timing, name) for name in stated}
        for name in stated & NAMES.keys():
            if f"timing.{NAMES[name]}" in self.sensor_changes and own[name] != in_file[name]:
                raise ValueError(
                    f"sensor_changes.timing.{NAMES[name]} = {in_file[name]:g} has no effect where the scenario itself "
                    f"states timing.{name} = {own[name]:g}"
                )
        try:
            timing = Timing(**(in_file | own))
        except ValidationError as error:
            raise ValueError(f"timing of the sensor {self.sensor!r}: {one_line(error, Timing)}") from error
        self.__dict__["timing"] = Timing.model_construct(_fields_set=set(stated), **timing.model_dump())
        if "sensor_note" not in self.model_fields_set:
            self.__dict__["sensor_note"] = note

    def _check_filter(self) -> None:
        nyquist, cutoff = self.timing.frame_rate_hz / 2, self.filter.cutoff_hz
        highest = self.excitation.fundamental_hz * self.excitation.harmonics
        if nyquist <= highest:
            raise ValueError(
                f"timing.frame_rate_hz = {self.timing.frame_rate_hz:g} Hz is not above twice the highest harmonic of "
                f"the excitation, {highest:g} Hz"
            )
        if cutoff >= nyquist:
            raise ValueError(
                f"filter.cutoff_hz = {cutoff:g} Hz is not below the Nyquist frequency {nyquist:g} Hz "
                f"of timing.frame_rate_hz = {self.timing.frame_rate_hz:g} Hz"
            )
        if cutoff <= highest:
            raise ValueError(
                f"filter.cutoff_hz = {cutoff:g} Hz would remove the excitation, "
                f"whose highest harmonic is {highest:g} Hz"
            )

    def _check_excitation_fits_the_filter(self) -> None:
        padding = padding_samples(self.timing.frame_rate_hz, self.filter.cutoff_hz, self.filter.order)
        if self.timing.frames(self.excitation.duration_s) <= padding:
            raise ValueError(
                f"excitation.duration_s = {self.excitation.duration_s:g} s is too short for the filter, which needs "
                f"more than {padding} frames ({padding / self.timing.frame_rate_hz:.3g} s)"
            )

    def _check_whole_frames(self, key: str, duration_s: float) -> None:
        frames = duration_s * self.timing.frame_rate_hz
        if abs(frames - round(frames)) > 1e-6 or round(frames) < 1:
            raise ValueError(
                f"{key} = {duration_s:g} s is {frames:g} frames at {self.timing.frame_rate_hz:g} Hz, "
                "not a whole number of frames"
            )

    def with_overrides(self, overrides: Mapping[str, Any]) -> "Scenario":
        """Copy with values replaced by dotted path, such as ``{"timing.frame_rate_hz": 30.0}``; None takes one back.

        What this scenario took from its sensor is taken again, from the copy's.

        Raises:
            ScenarioError: a path that does not exist (with the valid names) or a value that does not fit.
        """
        data = self.model_dump(exclude_none=True, exclude_unset=True)
        for path, value in overrides.items():
            _replace(data, path, value)
        return scenario_from_dict(data, source=f"scenario {self.name!r}")

    def to_toml(self) -> str:
        """Fully resolved TOML text, every default written out with its unit; reading it gives an equal scenario."""
        return to_toml(self)


def scenario_names() -> list[str]:
    """Names of the built-in scenarios."""
    return sorted(path.stem for path in BUILT_IN.glob("*.toml"))


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Load a built-in scenario by name, or one from a TOML file.

    Raises:
        ScenarioError: no such scenario (with the built-in names), no TOML, or wrong content.
    """
    text, source = _read(name_or_path)
    return scenario_from_toml(text, source)


def scenario_from_toml(text: str, source: str = "scenario") -> Scenario:
    """Scenario from TOML text; ``source`` names it in error messages.

    Raises:
        ScenarioError: no TOML, or wrong content.
    """
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{source} is not valid TOML: {error}") from error
    return scenario_from_dict(data, source)


def scenario_from_dict(data: Mapping[str, Any], source: str = "scenario") -> Scenario:
    """Scenario from nested mappings, all wrong entries named in one line.

    Raises:
        ScenarioError: unknown keys, wrong types or values, or settings that contradict each other.
    """
    try:
        return Scenario.model_validate(dict(data))
    except ValidationError as error:
        raise ScenarioError(f"{source}: {one_line(error, Scenario)}") from error


def _read(name_or_path: str | Path) -> tuple[str, str]:
    name = str(name_or_path)
    if name in scenario_names():
        return (BUILT_IN / f"{name}.toml").read_text(encoding="utf-8"), f"scenario {name!r}"
    path = Path(name)
    try:
        return path.read_text(encoding="utf-8"), f"scenario file {name}"
    except (OSError, UnicodeDecodeError) as error:
        reason = f", and {error}" if path.exists() else " nor a file"
        raise ScenarioError(
            f"scenario {name!r} is neither built in ({', '.join(scenario_names())}){reason}"
        ) from error


def _replace(data: dict[str, Any], path: str, value: Any) -> None:
    *sections, key = path.split(".", 1 if path.startswith("sensor_changes.") else -1)
    for section in sections:
        data = data.setdefault(section, {})
        if not isinstance(data, dict):
            raise ScenarioError(f"override {path!r}: {section!r} is a value, not a section")
    if value is None:
        data.pop(key, None)
    else:
        data[key] = value
