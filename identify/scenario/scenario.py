"""A scenario: everything that decides a synthetic experiment, read from TOML and checked as a
whole.

Each field states its unit; an error names the key, the value, the unit and, for a wrong name, the
valid names.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field, field_validator, model_validator

from dynamics.files import Name
from identify.errors import ScenarioError
from identify.filtering import padding_samples
from identify.scenario.parameter_names import check_parameter_names
from identify.scenario.plant_sections import Control, Model, Plant, Servo
from identify.scenario.section import Section
from identify.scenario.sections import (
    GEOMETRY_KNOWN,
    RIG_KNOWN,
    Excitation,
    Filter,
    Geometry,
    Identification,
    Payload,
    Rig,
    Validation,
)
from identify.scenario.settings_file import SettingsFiles, to_toml
from identify.scenario.timing import IN_FILE, Timing, by_dotted_key, completed, sensor_names


class Scenario(Section):
    """A whole synthetic experiment; load one with `load_scenario`."""

    name: Name = Field(description="short name, used for folders")
    description: str = ""
    robot: str = Field(
        "rss6", description="built-in robot, or path of a robot file from this file on"
    )
    sensor: str = Field(
        "ctrack780", description="built-in sensor, or path of a sensor file from this file on"
    )
    sensor_note: str = Field("", description="what the sensor's file says about its own figures")
    sensor_changes: dict[str, Any] = Field(
        {}, description="entries that hold instead of the sensor file's"
    )
    renderer: str = Field(
        "auto",
        description="what draws the images: pyrender, analytic, auto: pyrender where OpenGL "
        "works, or module:name; "
        "statistical: nothing, it says what would be found in them",
    )
    pose_method: Literal["registration", "planes"] = "registration"
    rig: Rig = Rig()
    timing: Timing = Timing()
    servo: Servo = Servo()
    control: Control = Control()
    plant: Plant = Plant()
    model: Model = Model()
    excitation: Excitation = Excitation()
    filter: Filter = Filter()
    identification: Identification = Identification()
    # made late: its check is one of dynamics, which loads CasADi
    payload: Payload = Field(default_factory=Payload)
    validation: Validation = Validation()
    geometry: Geometry = Geometry()

    @field_validator("renderer")
    @classmethod
    def _known_renderer(cls, name: str) -> str:
        from cmmsim.plugins import (
            require_renderer,
        )  # the command line's help must not wait for the sensor

        return require_renderer(name)

    @field_validator("sensor_changes")
    @classmethod
    def _by_dotted_key(cls, changes: dict[str, Any]) -> dict[str, Any]:
        return by_dotted_key(changes)

    @model_validator(mode="before")
    @classmethod
    def _names_parameters_of_its_robot(cls, values: Any) -> Any:
        if isinstance(values, Mapping):
            section = values.get("identification")
            robot = values.get("robot", cls.model_fields["robot"].default)
            known = (
                section.get("prior")
                if isinstance(section, Mapping)
                else getattr(section, "prior", None)
            )
            if isinstance(known, Mapping) and isinstance(robot, str):
                check_parameter_names(known, robot)
        return values

    @model_validator(mode="after")
    def _fits_together(self) -> "Scenario":
        self._complete_from_the_sensor()
        self.timing.check()
        self._check_filter()
        self._check_excitation_fits_the_filter()
        self._check_whole_frames("excitation.duration_s", self.excitation.duration_s)
        self._check_whole_frames("validation.duration_s", self.validation.duration_s)
        return self

    def _complete_from_the_sensor(self) -> None:
        """Fill in the timing and the note that the scenario leaves to its sensor."""
        whole = (
            self.timing.model_fields_set.issuperset(IN_FILE)
            and "sensor_note" in self.model_fields_set
        )
        if whole and not self.sensor_changes:
            return
        timing, note = completed(self.timing, self.sensor, self.sensor_changes)
        self.__dict__["timing"] = timing
        if "sensor_note" not in self.model_fields_set:
            self.__dict__["sensor_note"] = note

    def _check_filter(self) -> None:
        nyquist = self.timing.frame_rate_hz / 2
        cutoff = self.filter.cutoff_hz
        highest = self.excitation.fundamental_hz * self.excitation.harmonics
        if nyquist <= highest:
            raise ValueError(
                f"timing.frame_rate_hz = {self.timing.frame_rate_hz:g} Hz is not above twice the "
                "highest harmonic of "
                f"the excitation, {highest:g} Hz"
            )
        if cutoff >= nyquist:
            raise ValueError(
                f"filter.cutoff_hz = {cutoff:g} Hz is not below the Nyquist frequency {nyquist:g} "
                "Hz "
                f"of timing.frame_rate_hz = {self.timing.frame_rate_hz:g} Hz"
            )
        if cutoff <= highest:
            raise ValueError(
                f"filter.cutoff_hz = {cutoff:g} Hz would remove the excitation, "
                f"whose highest harmonic is {highest:g} Hz"
            )

    def _check_excitation_fits_the_filter(self) -> None:
        padding = padding_samples(
            self.timing.frame_rate_hz, self.filter.cutoff_hz, self.filter.order
        )
        if self.timing.frames(self.excitation.duration_s) <= padding:
            raise ValueError(
                f"excitation.duration_s = {self.excitation.duration_s:g} s is too short for the "
                "filter, which needs "
                f"more than {padding} frames ({padding / self.timing.frame_rate_hz:.3g} s)"
            )

    def _check_whole_frames(self, key: str, duration_s: float) -> None:
        frames = duration_s * self.timing.frame_rate_hz
        if abs(frames - round(frames)) > 1e-6 or round(frames) < 1:
            raise ValueError(
                f"{key} = {duration_s:g} s is {frames:g} frames at {self.timing.frame_rate_hz:g} "
                "Hz, "
                "not a whole number of frames"
            )

    def with_overrides(self, overrides: Mapping[str, Any]) -> "Scenario":
        """Copy with values replaced by dotted path, such as ``{"timing.frame_rate_hz": 30.0}``;
        None takes one back.

        A path among them starts from the current folder, and the copy holds it absolute, as files
        leave it. What this scenario took from its sensor is taken again, from the copy's.

        Raises ScenarioError: a path that does not exist (with the valid names) or a value that does
        not fit.
        """
        data = self.model_dump(exclude_none=True, exclude_unset=True)
        for path, value in overrides.items():
            _replace(data, path, value)
        return SCENARIOS.from_dict(data, f"scenario {self.name!r}")

    def to_toml(self) -> str:
        """Fully resolved TOML text, every default written out with its unit; reading it gives an
        equal scenario.
        """
        return to_toml(self)


def _robot_names() -> list[str]:
    from dynamics.robot_file import built_in_robots

    return built_in_robots()


SCENARIOS = SettingsFiles(
    "scenario",
    Path(__file__).parent / "built_in",
    Scenario,
    ScenarioError,
    {
        "robot": _robot_names,
        "sensor": sensor_names,
        "rig.known": lambda: RIG_KNOWN,
        "geometry.known": lambda: GEOMETRY_KNOWN,
    },
)


def scenario_names() -> list[str]:
    """Names of the built-in scenarios."""
    return SCENARIOS.names()


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Load a built-in scenario by name, or one from a TOML file, from whose folder its paths start.

    Raises ScenarioError: no such scenario (with the built-in names), no TOML, or wrong content.
    """
    return SCENARIOS.load(name_or_path)


def scenario_from_toml(text: str, source: str = "scenario") -> Scenario:
    """Scenario from TOML text; ``source`` names it in error messages, and its paths start from the
    current folder.

    Raises ScenarioError: no TOML, or wrong content.
    """
    return SCENARIOS.from_toml(text, source)


def scenario_schema() -> dict[str, Any]:
    """JSON schema of scenario files, for editors; `built_in/scenario.schema.json` holds it."""
    return Scenario.model_json_schema()


def numbers_by_name() -> Iterator[str]:
    """The keys of a scenario, dotted, whose values are tables of numbers by names, which may have
    dots themselves.
    """
    for section, field in Scenario.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            entries = field.annotation.model_fields.items()
            yield from (
                f"{section}.{name}"
                for name, entry in entries
                if entry.annotation == dict[str, float]
            )


def _replace(data: dict[str, Any], path: str, value: Any) -> None:
    table = next(
        (one for one in ("sensor_changes", *numbers_by_name()) if path.startswith(f"{one}.")), ""
    )
    *sections, key = path.split(".", table.count(".") + 1 if table else -1)
    for section in sections:
        data = data.setdefault(section, {})
        if not isinstance(data, dict):
            raise ScenarioError(f"override {path!r}: {section!r} is a value, not a section")
    if value is None:
        data.pop(key, None)
    else:
        data[key] = value


SECTIONS = ("identification", "model", "filter")
"""What of a scenario is the estimator's alone: it may change after the record was made, all else
may not.
"""

RECORDED = ("identification.scale_anchor", "identification.anchor_std")
"""Settings of these sections that a record follows all the same: it holds what its anchor measured.
"""


def with_estimator_settings(scenario: Scenario, overrides: Mapping[str, Any]) -> Scenario:
    """Copy of the scenario of a record with other settings of the estimator, by dotted path.

    Raises ScenarioError: a setting that the record was made with (with the sections allowed), or as
    `with_overrides` does.
    """
    for path in overrides:
        section, _, name = path.partition(".")
        if section not in SECTIONS or not name or path in RECORDED:
            allowed = ", ".join(f"{allowed}.*" for allowed in SECTIONS)
            raise ScenarioError(
                f"{path!r} cannot be set for an identification: the record was made with the rest "
                "of the scenario; "
                f"allowed: {allowed}, except {' and '.join(RECORDED)}"
            )
    return scenario.with_overrides(overrides) if overrides else scenario


def estimator_settings(scenario: Scenario) -> dict[str, Any]:
    """All settings of the estimator by dotted path; those that are not set are left out."""
    return {
        f"{section}.{name}": value
        for section in SECTIONS
        for name, value in getattr(scenario, section).model_dump(exclude_none=True).items()
    }
