"""Base of all sections of a scenario: fields with units and limits, and keys for actuators."""

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from dynamics.checks import (
    Damping,
    Duration,
    Force,
    Frequency,
    Gain,
    Inertia,
    Margin,
    Mass,
    Ratio,
    Speed,
    within,
)

# Keys of the joint settings, for turning and for sliding actuators.
ACTUATOR_KEYS = {
    "smoothing_velocity": ("smoothing_velocity_rad_s", "smoothing_velocity_m_s"),
    "stribeck_velocity": ("stribeck_velocity_rad_s", "stribeck_velocity_m_s"),
    "friction_offset": ("friction_offset_N_m", "friction_offset_N"),
    "friction_offset_std": ("friction_offset_std_N_m", "friction_offset_std_N"),
    "stribeck_velocity_std": ("stribeck_velocity_std_rad_s", "stribeck_velocity_std_m_s"),
    "joint_stiffness": ("joint_stiffness_N_m_rad", "joint_stiffness_N_m"),
    "joint_damping": ("joint_damping_N_m_s_rad", "joint_damping_N_s_m"),
    "motor_inertia": ("motor_inertia_kg_m2", "motor_mass_kg"),
    "travel_margin": ("travel_margin_rad", "travel_margin_m"),
    "encoder_noise": ("encoder_noise_rad", "encoder_noise_m"),
    "encoder_resolution": ("encoder_resolution_rad", "encoder_resolution_m"),
    "encoder_offset": ("encoder_offset_rad", "encoder_offset_m"),
    "joint_zero_std": ("joint_zero_std_rad", "joint_zero_std_m"),
    "joint_zero_error": ("joint_zero_error_rad", "joint_zero_error_m"),
    "command_quantum": ("command_quantum_rad", "command_quantum_m"),
    "command_limits": ("command_limits_rad", "command_limits_m"),
    "torque_limit": ("torque_limit_N_m", "torque_limit_N"),
    "max_joint_velocity": ("max_joint_velocity_rad_s", "max_joint_velocity_m_s"),
}


# Range of values for each unit.
RANGES = {
    "Hz": within(Frequency),
    "rad/s": within(Speed),
    "m/s": within(Speed),
    "s": within(Duration),
    "m": within(Margin),
    "rad": within(Margin),
    "kg": within(Mass),
    "kg m2": within(Inertia),
    "N m": within(Force),
    "N": within(Force),
    "N m/rad": within(Gain),
    "N/m": within(Gain),
    "N m s/rad": within(Damping),
    "N s/m": within(Damping),
    "1/s": within(Gain),
    "1": within(Ratio),
}


def quantity(default: Any, unit: str, what: str, **limits: Any) -> Any:
    """Return a field with a unit, whose values must be in the range of the unit.

    ``limits`` are additional limits in pydantic's form, such as ge and lt. For a field that can be
    negative, only these limits apply.
    """
    field = Field(default, description=what, json_schema_extra={"unit": unit}, **limits)
    if unit in RANGES and not limits.get("ge", 0) < 0:
        # As a validator in the field's metadata, the range is checked in addition to the limits.
        field.metadata.append(RANGES[unit])
    return field


class Section(BaseModel):
    """Base of all sections.

    Sections are frozen. Keys must be known, numbers finite, and types exact, or an int for a float.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)
