"""Scenario: settings of a synthetic experiment, read from TOML and checked for consistency.

Each field states its unit. An error names the key, the value and the unit and, for a wrong name,
the valid names.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from pydantic import BaseModel, Field, field_validator, model_validator

from dynamics.files import Name, is_file
from identify.errors import ScenarioError
from identify.filtering import padding_samples
from identify.scenario.loop_sections import Control, Servo
from identify.scenario.parameter_names import check_parameter_names
from identify.scenario.payload import Payload
from identify.scenario.plant_sections import DriveName, Model, Plant
from identify.scenario.section import Section
from identify.scenario.sections import (
    GEOMETRY_KNOWN,
    RIG_KNOWN,
    Excitation,
    Filter,
    Geometry,
    Identification,
    Rig,
    Validation,
)
from identify.scenario.settings_file import SettingsFiles, to_toml
from identify.scenario.timing import IN_FILE, Timing, by_dotted_key, completed, sensor_names

if TYPE_CHECKING:
    from cmmsim.files import SensorFile

# Sections of a scenario with the settings of the estimator. A user can change these, and no other
# sections, after the record was made.
ESTIMATOR_SECTIONS = ("identification", "model", "filter")
# Settings in these sections on which the record depends. The record includes what its scale anchor
# measured.
RECORDED = ("identification.scale_anchor", "identification.anchor_std")
# Entries outside of [timing] that come from the sensor file where the scenario does not state them.
FROM_SENSOR = ("sensor_note", "renderer")


class Scenario(Section):
    """Complete synthetic experiment. It is loaded by `load_scenario`."""

    name: Name = Field(description="short name, used for folders")
    description: str = ""
    robot: str = Field(
        "rss6", description="built-in robot, or path of a robot file relative to this file"
    )
    sensor: str = Field(
        "ctrack780", description="built-in sensor, or path of a sensor file relative to this file"
    )
    sensor_note: str = Field("", description="note from the sensor file about its figures")
    sensor_changes: dict[str, Any] = Field(
        {}, description="entries that replace those of the sensor file"
    )
    renderer: str = Field(
        "auto",
        description="renderer of the images, by default that of the sensor file; pyrender; "
        "analytic; scene; auto, which is pyrender if OpenGL works; module:function; or "
        "statistical, which has no images and draws errors of sticker centres",
    )
    pose_method: Literal["registration", "planes"] = Field(
        "registration",
        description="how a pose follows from the stickers: registration, which fits their taught "
        "places; or planes, which fits the planes A, B and C of each body",
    )
    rig: Rig = Rig()
    timing: Timing = Timing()
    servo: Servo = Servo()
    control: Control = Control()
    plant: Plant = Plant()
    model: Model = Model()
    excitation: Excitation = Excitation()
    filter: Filter = Filter()
    identification: Identification = Identification()
    # Made late, because its check imports dynamics, which loads CasADi.
    payload: Payload = Field(default_factory=Payload)
    validation: Validation = Validation()
    geometry: Geometry = Geometry()

    @field_validator("renderer")
    @classmethod
    def _known_renderer(cls, name: str) -> str:
        # A late import: the command line's help must not wait for the sensor.
        from cmmsim.allowed_plugins import require_renderer

        return require_renderer(name)

    @field_validator("sensor_changes")
    @classmethod
    def _by_dotted_key(cls, changes: dict[str, Any]) -> dict[str, Any]:
        return by_dotted_key(changes)

    @model_validator(mode="before")
    @classmethod
    def _names_parameters_of_its_robot(cls, values: Any) -> Any:
        if isinstance(values, Mapping):
            # These are raw values: a section may be a dictionary or already a model.
            section = values.get("identification")
            robot = values.get("robot", cls.model_fields["robot"].default)
            if isinstance(section, Mapping):
                known = section.get("prior")
            else:
                known = getattr(section, "prior", None)
            if isinstance(known, Mapping) and isinstance(robot, str):
                check_parameter_names(known, robot)
        return values

    @model_validator(mode="after")
    def _fits_together(self) -> "Scenario":
        self._complete_from_the_sensor()
        self.timing.check()
        self._check_zeros()
        self._check_filter()
        self._check_excitation_fits_the_filter()
        self._check_whole_frames("excitation.duration_s", self.excitation.duration_s)
        self._check_whole_frames("validation.duration_s", self.validation.duration_s)
        return self

    def _check_zeros(self) -> None:
        """Check that the zeros of the joints are not stated twice."""
        for name in ("joint_zero_std_rad", "joint_zero_std_m"):
            value = getattr(self.model, name)
            if value and not self.geometry.exact:
                raise ValueError(
                    f"model.{name} = {value:g} with geometry.known = {self.geometry.known!r}: the "
                    "covariance of that calibration contains the zeros of the joints; set only one "
                    "of the two"
                )

    def _complete_from_the_sensor(self) -> None:
        """Fill in, from the sensor, what the scenario does not state: timing, note and renderer."""
        whole = self.timing.model_fields_set.issuperset(IN_FILE) and (
            self.model_fields_set.issuperset(FROM_SENSOR)
        )
        if whole and not self.sensor_changes:
            return
        timing, others = completed(self.timing, self.sensor, self.sensor_changes)
        # Bypass the frozen model, so that these values do not count as set: with another sensor,
        # they come from that sensor.
        self.__dict__["timing"] = timing
        for name, value in zip(FROM_SENSOR, others, strict=True):
            if name not in self.model_fields_set:
                self.__dict__[name] = value

    def _check_filter(self) -> None:
        nyquist = self.timing.frame_rate_hz / 2
        cutoff = self.filter.cutoff_hz
        highest = self.excitation.fundamental_hz * self.excitation.harmonics
        if nyquist <= highest:
            raise ValueError(
                f"timing.frame_rate_hz = {self.timing.frame_rate_hz:g} Hz is not above twice the "
                f"highest harmonic of the excitation, {highest:g} Hz"
            )
        if cutoff >= nyquist:
            raise ValueError(
                f"filter.cutoff_hz = {cutoff:g} Hz is not below the Nyquist frequency {nyquist:g} "
                f"Hz of timing.frame_rate_hz = {self.timing.frame_rate_hz:g} Hz"
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
                f"filter, which needs more than {padding} frames "
                f"({padding / self.timing.frame_rate_hz:.3g} s)"
            )

    def _check_whole_frames(self, key: str, duration_s: float) -> None:
        frames = duration_s * self.timing.frame_rate_hz
        # Because of rounding, the product of decimal numbers may not be exactly whole.
        if abs(frames - round(frames)) > 1e-6 or round(frames) < 1:
            raise ValueError(
                f"{key} = {duration_s:g} s is {frames:g} frames at {self.timing.frame_rate_hz:g} "
                "Hz, not a whole number of frames"
            )

    def with_overrides(self, overrides: Mapping[str, Any]) -> "Scenario":
        """Return a copy with values replaced by dotted path.

        An example is ``{"timing.frame_rate_hz": 30.0}``. None restores the default. A value that is
        a path is relative to the current folder, and becomes an absolute path in the copy. Values
        that this scenario has from its sensor come from the sensor of the copy.

        Raises ScenarioError if a dotted path does not exist (with the valid names) or a value is
        not valid.
        """
        # Values that are not set are left out, so that another sensor can provide them.
        data = self.model_dump(exclude_none=True, exclude_unset=True)
        try:
            for path, value in overrides.items():
                _replace(data, path, value)
            return SCENARIOS.from_dict(data, f"scenario {self.name!r}")
        except ScenarioError as error:
            raise ScenarioError(f"{error}{_of_sensor(overrides)}") from None

    def with_estimator_settings(self, overrides: Mapping[str, Any]) -> "Scenario":
        """Return the scenario of a record with other settings of the estimator, by dotted path.

        Raises ScenarioError if a setting is not one of the estimator (with the allowed sections),
        and as `with_overrides` does.
        """
        for path in overrides:
            section, _, name = path.partition(".")
            if section not in ESTIMATOR_SECTIONS or not name or path in RECORDED:
                allowed = ", ".join(f"{allowed}.*" for allowed in ESTIMATOR_SECTIONS)
                raise ScenarioError(
                    f"{path!r} cannot be set for an identification: the record was made with the "
                    f"rest of the scenario; allowed: {allowed}, except {' and '.join(RECORDED)}"
                )
        return self.with_overrides(overrides) if overrides else self

    def estimator_settings(self) -> dict[str, Any]:
        """Return all settings of the estimator by dotted path, except those that are None."""
        return {
            f"{section}.{name}": value
            for section in ESTIMATOR_SECTIONS
            for name, value in getattr(self, section).model_dump(exclude_none=True).items()
        }

    def with_drive(self, law: DriveName) -> "Scenario":
        """Return a copy with an identified law of the drives, if its model leaves the law open."""
        return self.model_copy(update={"model": self.model.with_drive(law)})

    def sensor_file(self) -> "SensorFile":
        """Return the sensor's file, with the changes and the timing of this scenario."""
        return self.timing.in_sensor_file(self.sensor, self.sensor_changes)

    def to_toml(self) -> str:
        """Return TOML text with all values, including defaults, and their units.

        Reading it gives an equal scenario.
        """
        return to_toml(self)


def _robot_names() -> list[str]:
    # A late import, as dynamics loads CasADi.
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
    """Return the names of the built-in scenarios."""
    return SCENARIOS.names()


def load_scenario(name_or_path: str | Path, **entries: Any) -> Scenario:
    """Load a built-in scenario by name, or a scenario from a TOML file.

    Paths in a file are relative to the folder of the file.

    Parameters
    ----------
    name_or_path : str or Path
        Name of a built-in scenario, see `scenario_names`, or path of a file.
    **entries
        Values that replace those of the file: entries by name, sections as dictionaries.

    Returns
    -------
    Scenario
        Scenario, checked for consistency.

    Raises
    ------
    ScenarioError
        There is no such scenario or entry (with the valid names), or a value is not valid.

    Examples
    --------
    >>> load_scenario("quick", renderer="analytic", timing={"latency_s": 0.01}).timing.latency_s
    0.01
    """
    scenario = SCENARIOS.load(name_or_path)
    if not entries:
        return scenario
    changed = scenario.with_overrides(dict(_dotted(entries)))
    if "robot" in entries and changed.robot not in _robot_names() and not is_file(changed.robot):
        raise ScenarioError(
            f"robot {changed.robot[:200]!r} is neither built in ({', '.join(_robot_names())}) nor "
            "a file"
        )
    return changed


def _dotted(entries: Mapping[str, Any], section: str = "") -> Iterator[tuple[str, Any]]:
    """Yield entries of nested dictionaries by dotted path."""
    for key, value in entries.items():
        if isinstance(value, Mapping):
            yield from _dotted(value, f"{section}{key}.")
        else:
            yield f"{section}{key}", value


def scenario_from_toml(text: str, source: str = "scenario") -> Scenario:
    """Read a scenario from TOML text, whose paths are relative to the current folder.

    ``source`` names the text in error messages. Raises ScenarioError if the text is not TOML or not
    a valid scenario.
    """
    return SCENARIOS.from_toml(text, source)


def scenario_schema() -> dict[str, Any]:
    """Return the JSON schema of scenario files. It is saved in `built_in/scenario.schema.json`."""
    return Scenario.model_json_schema()


def tables_by_name() -> Iterator[tuple[str, Any]]:
    """Yield the dotted keys whose values can be tables by name, and the type of their entries.

    The names can contain dots.
    """
    for section, field in Scenario.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            for name, entry in field.annotation.model_fields.items():
                for form in (entry.annotation, *get_args(entry.annotation)):
                    # Entries that are sections have paths of their own.
                    if get_origin(form) is dict and not isinstance(
                        get_args(form)[1], type(Section)
                    ):
                        yield f"{section}.{name}", get_args(form)[1]


def _replace(data: dict[str, Any], path: str, value: Any) -> None:
    # Names in a table by name can contain dots, so the path is split only up to the table.
    tables = ("sensor_changes", *(table for table, _ in tables_by_name()))
    table = next((one for one in tables if path.startswith(f"{one}.")), "")
    *sections, key = path.split(".", table.count(".") + 1 if table else -1)
    for section in sections:
        data = data.setdefault(section, {})
        if not isinstance(data, dict):
            raise ScenarioError(f"override {path!r}: {section!r} is a value, not a section")
    if value is None:
        data.pop(key, None)
    else:
        data[key] = value


def _of_sensor(paths: Iterable[str]) -> str:
    """Return words on the first path that is a key of the sensor file, and none of a scenario."""
    from cmmsim.files import SensorFile

    for path in paths:
        key = path.removeprefix("sensor.")
        if not has_field(Scenario, path) and has_field(SensorFile, key):
            return f"; {key!r} is a key of the sensor file: set sensor_changes.{key}"
    return ""


def has_field(model: Any, path: str) -> bool:
    """Return whether a model has the field at the end of a dotted path."""
    for part in path.split("."):
        fields = getattr(model, "model_fields", {})
        if part not in fields:
            return False
        model = fields[part].annotation
    return True
