"""Sections of a scenario about excitation, estimator, cameras, validation and geometry.

Each field states its unit and its limits. A section checks only its own values.
"""

from typing import Literal, get_args

from pydantic import Field, field_validator, model_validator

from dynamics.checks import Within
from identify.own_parts import CRITERIA, LAWS, check_choice
from identify.scenario.section import Section, quantity


class Excitation(Section):
    """Exciting trajectory (eq. 37) and its optimisation (eq. 39)."""

    fundamental_hz: float = quantity(0.1, "Hz", "fundamental frequency f0", gt=0)
    harmonics: int = quantity(5, "1", "number of harmonics n", ge=2, le=100)
    duration_s: float = quantity(20.0, "s", "length of the excitation run", gt=0, le=3600)
    position_amplitude_m: float = quantity(
        0.010, "m", "largest distance from home in x, y and z", gt=0
    )
    orientation_amplitude_rad: float = quantity(
        0.04, "rad", "largest angle from home in each axis", gt=0, lt=1.5
    )
    travel_margin_rad: float = quantity(
        0.10, "rad", "smallest distance from the travel limit of the joints", ge=0
    )
    travel_margin_m: float = quantity(
        0.01, "m", "smallest distance from the travel limit of actuators that slide", ge=0
    )
    candidates: int = quantity(
        64,
        "1",
        "number of random trajectories, from which the method starts",
        ge=1,
        le=100_000,
    )
    method: Literal["random", "evolutionary", "gradient"] = Field(
        "random",
        description="search: random, evolutionary (differential evolution, as in the paper) or "
        "gradient (IPOPT)",
    )
    criterion: str = Field(
        "observability",
        description="observability (eq. 39), information (D-optimality of the output error), or "
        "module:function",
    )
    max_joint_velocity_rad_s: float = quantity(2.0, "rad/s", "largest velocity of a joint", gt=0)
    max_joint_velocity_m_s: float = quantity(
        0.2, "m/s", "largest velocity of an actuator that slides", gt=0
    )
    least_leverage: float = quantity(
        0.05, "1", "least leverage of an actuator on its leg (J_a1)", ge=0, lt=1
    )
    most_condition: float = quantity(
        20.0, "1", "largest condition number (2-norm) of the dimensionless J_a2", ge=1, le=1e9
    )
    law: str = Field(
        "pid",
        description=f"control law of the run, which uses the initial model: {', '.join(LAWS)}, or "
        "module:function; with any other law than pid, the model gets the logged commands",
    )
    generations: int = quantity(
        324,
        "1",
        "number of generations of the evolutionary method; the paper has 324",
        ge=1,
        le=100_000,
    )

    @property
    def singularity_limits(self) -> dict[str, float]:
        """Smallest leverage and largest condition number, as arguments of `check_motion`."""
        return {"least_leverage": self.least_leverage, "most_condition": self.most_condition}

    @field_validator("criterion")
    @classmethod
    def _can_be_found(cls, criterion: str) -> str:
        check_choice(criterion, "criterion", CRITERIA, ValueError)
        return criterion

    @field_validator("law")
    @classmethod
    def _law_can_be_found(cls, law: str) -> str:
        check_choice(law, "law", LAWS, ValueError)
        return law


class Filter(Section):
    """Zero-phase Butterworth filter of the measured poses."""

    order: int = quantity(8, "1", "order of the filter, applied forward and reverse", ge=1, le=20)
    cutoff_hz: float = quantity(10.0, "Hz", "cutoff frequency", gt=0)


class PriorValue(Section):
    """Prior knowledge of a parameter before the experiment, in its SI unit."""

    value: float = quantity(..., "SI", "expected value", ge=0, le=1e12)
    std: float = quantity(..., "SI", "standard deviation of the value", ge=1e-24, le=1e12)


# Range of the error or the drift of one parameter of a camera.
CAMERA_CHANGE = Within(-1e3, 1e3, "in the unit of the parameter")
# Ways in which a rig can be known, besides the path of a calibration result.
RIG_KNOWN = ["exact", "calibrated", "photographs"]


class Rig(Section):
    """Estimator's knowledge of the cameras, and their errors and drift.

    The true cameras, which take the images, are described in the sensor file.
    """

    known: str = Field(
        "exact",
        description="how well the cameras are known; exact; calibrated, from pictures of a board "
        "that the run takes first; photographs, with the covariance that fifteen photographs of a "
        "board leave; or the path of a calibration.json, with its covariance",
    )
    pairs: int = quantity(
        20, "1", "number of pairs of pictures of the board for calibrated", ge=3, le=500
    )
    errors: dict[str, float] = Field(
        {},
        description="true minus known camera parameters; no covariance includes these errors; "
        '{ "left.cx_px" = 0.1 }, in px, m or rad',
    )
    right_later_s: float | None = quantity(
        None,
        "s",
        "true delay of the right camera's exposure; drawn at random if not stated",
        ge=-0.1,
        le=0.1,
    )
    right_later_std_s: float = quantity(
        0.0,
        "s",
        "standard deviation of the delay of the right camera's exposure, whose expected value is "
        "zero",
        ge=0,
        le=0.1,
    )
    drift: dict[str, float] = Field(
        {},
        description="change of the true camera parameters from the first to the last frame of each "
        "run, without the estimator's knowledge; "
        '{ "right.cx_px" = 0.1 }, in px, m or rad',
    )
    watch: Literal["platform", "both", "none"] = Field(
        "platform",
        description="stickers that the drift watch uses; both means platform and base, and takes "
        "twice the time",
    )

    @field_validator("errors", "drift")
    @classmethod
    def _are_small(cls, changes: dict[str, float]) -> dict[str, float]:
        for name, value in changes.items():
            try:
                CAMERA_CHANGE.check(value)
            except ValueError as error:
                raise ValueError(f"{name}: {error}") from None
        return changes

    @property
    def exact(self) -> bool:
        """True if the estimator takes the rig and its exposures as exact."""
        return self.known == "exact" and self.right_later_std_s == 0.0


# Ways in which a geometry can be known, besides the path of a calibrated robot.
GEOMETRY_KNOWN = ["exact", "calibrated"]


# Kinds of errors that all poses of a record have in common.
Nuisance = Literal[
    "rig",
    "teaching",
    "exposure",
    "latency",
    "clock",
    "start",
    "zeros",
    "scale",
    "friction",
    "geometry",
    "centres",
    "products",
    "passive_friction",
]


class Identification(Section):
    """Output-error estimation and its stop criteria (eq. 35)."""

    method: Literal["closed_loop", "command_driven"] = Field(
        "closed_loop",
        description="closed_loop (the model closes its own loop, as in the paper) or "
        "command_driven (the model gets the logged commands)",
    )
    scale_anchor: Literal["platform_mass", "joint_gain", "payload", "prior"] = Field(
        "platform_mass",
        description="quantity that fixes the common factor of all parameters; payload records a "
        "second run",
    )
    anchor_std: float | None = quantity(
        None,
        "unit of the anchor",
        "standard deviation of the anchor; if none is given, a simulated experiment has that of an "
        "ordinary instrument: 0.005 kg, 0.01 N m/rad or 5 N/m",
        gt=0,
    )
    start_std: float = quantity(
        1.0,
        "1",
        "standard deviation of the initial guess, relative to each value",
        ge=1e-9,
        le=1e9,
    )
    prior: dict[str, PriorValue] = Field(
        {},
        description="parameters that are known better than the initial guess: { name = { value, "
        "std } }",
    )
    nuisances: list[Nuisance] = Field(
        list(get_args(Nuisance)),
        description="errors common to all poses that are estimated beside the parameters",
    )
    physical_consistency: bool = Field(
        False,
        description="whether only masses and moments of inertia of rigid bodies are admitted; "
        "some of the paper's are not",
    )
    max_iterations: int = quantity(
        30, "1", "largest number of iterations of each search", ge=1, le=1000
    )
    cost_tolerance: float = quantity(
        1e-6, "1", "tol1 of eq. 35, relative change of the cost", gt=0, lt=1
    )
    parameter_tolerance: float = quantity(
        1e-3, "1", "tol2 of eq. 35, relative change of a parameter", gt=0, lt=1
    )
    qr_threshold: float = quantity(
        1e-3,
        "1",
        "diagonal entries of R above this value count in base_rank (section 4.2)",
        ge=1e-15,
        le=1,
    )

    @model_validator(mode="after")
    def _anchor_measures_what_is_stated(self) -> "Identification":
        if self.anchor_std is not None and self.scale_anchor in ("payload", "prior"):
            hint = ""
            if self.scale_anchor == "payload":
                hint = "; payload.mass_std_kg states how well its load is known"
            raise ValueError(
                f"anchor_std = {self.anchor_std:g}: the anchor {self.scale_anchor} measures no "
                f"parameter{hint}"
            )
        return self


class Validation(Section):
    """Validation: trajectories, not used in the identification, on which the model is judged."""

    count: int = quantity(10, "1", "number of validation trajectories", ge=1, le=1000)
    duration_s: float = quantity(10.0, "s", "length of each validation trajectory", gt=0, le=3600)


class Geometry(Section):
    """Kinematic calibration by static poses (`cmmsim geometry`).

    The section also states how well servo and estimator of a run know the geometry.
    """

    known: str = Field(
        "exact",
        description="how well the geometry is known; exact, as in the robot file; calibrated, by "
        "static poses that the run measures first; or the path of the robot.toml of a calibration, "
        "with its covariance beside it",
    )
    poses: int = quantity(60, "1", "number of poses that are measured", ge=1, le=10_000)
    frames_per_pose: int = quantity(
        20, "1", "number of frames whose mean is a measured pose", ge=1, le=10_000
    )
    selection: Literal["random", "greedy", "gradient"] = Field(
        "gradient",
        description="choice of the poses: random, greedy (the best of the candidates) or gradient "
        "(moved along the gradient of the index)",
    )
    criterion: Literal["prediction", "determinant", "noise_amplification"] = Field(
        "prediction",
        description="index of the choice: prediction (mean error of other poses), determinant (of "
        "the information) or noise_amplification (Nahvi and Hollerbach)",
    )
    candidates: int = quantity(
        400, "1", "number of random poses within the travel to choose from", ge=1, le=100_000
    )
    measurement: Literal["images", "drawn"] = Field(
        "images", description="images, or poses drawn with the noise that the sensor states"
    )
    frames: Literal["taught", "unknown"] = Field(
        "taught",
        description="knowledge of the base and platform frames: taught, with the covariance of "
        "teaching, or unknown",
    )
    tolerance_m: float = quantity(
        1e-3, "m", "standard deviation of positions and lengths from the drawing", gt=0
    )
    tolerance_rad: float = quantity(
        1e-2, "rad", "standard deviation of axes and zero angles from the drawing", gt=0
    )
    encoder_noise_rad: float = quantity(
        1e-5, "rad", "standard deviation of one reading of an encoder", ge=0
    )
    encoder_noise_m: float = quantity(
        1e-6, "m", "standard deviation of one reading of an encoder of actuators that slide", ge=0
    )
    encoder_resolution_rad: float = quantity(
        4.8e-5, "rad", "step of an encoder, here of 17 bits; 0 means no steps", ge=0
    )
    encoder_resolution_m: float = quantity(
        1e-6, "m", "step of an encoder of actuators that slide; 0 means no steps", ge=0
    )
    encoder_offset_rad: float = quantity(
        0.0, "rad", "standard deviation of the reading of an encoder at zero", ge=0, le=0.05
    )
    encoder_offset_m: float = quantity(
        0.0,
        "m",
        "standard deviation of the reading of an encoder at zero, for actuators that slide",
        ge=0,
        le=0.01,
    )
    unseen: int = quantity(
        200,
        "1",
        "number of validation poses, which are not measured, to judge the result",
        ge=1,
        le=100_000,
    )

    @model_validator(mode="after")
    def _stands_where_it_is_known(self) -> "Geometry":
        # A calibration works with unknown frames; a run needs the position of the robot.
        if self.known == "calibrated" and self.frames == "unknown":
            raise ValueError(
                "known = 'calibrated' with frames = 'unknown': the position of the robot would not "
                "be known; a run needs frames = 'taught'"
            )
        return self

    @property
    def exact(self) -> bool:
        """True if servo and estimator take the robot file's geometry as exact."""
        return self.known == "exact"
