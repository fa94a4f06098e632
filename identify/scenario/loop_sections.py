"""Sections of a scenario about what moves the robot: the visual servo and the control law."""

from pydantic import Field, field_validator

from identify.own_parts import LAWS, check_choice
from identify.scenario.section import Section, quantity


class Servo(Section):
    """Gains of the outer visual servo (eq. 30)."""

    kp: float = quantity(0.3, "1", "proportional gain", ge=0, le=1e6)
    kd: float = quantity(0.001, "s", "derivative gain", ge=0)
    ki: float = quantity(2.4, "1/s", "integral gain", ge=0)


class Control(Section):
    """Law by which `cmmsim track` makes the robot follow a motion.

    All other runs use the law pid, except the excitation, which has its own key. The torque limit
    applies to all runs, and the model includes it.
    """

    law: str = Field("pid", description=f"control law: {', '.join(LAWS)}, or module:function")
    observer: bool = Field(
        True,
        description="whether an observer predicts the pose for laws with a model",
    )
    torque_access: bool = Field(
        True, description="whether the drives take torques; otherwise only joint commands"
    )
    torque_limit_N_m: float | None = quantity(None, "N m", "largest torque of an actuator", gt=0)
    torque_limit_N: float | None = quantity(
        None, "N", "largest force of an actuator that slides", gt=0
    )
    bandwidth_rad_s: float | None = quantity(
        None,
        "rad/s",
        "bandwidth of the law computed_torque; by default as fast as frame rate and latency allow",
        gt=0,
    )
    damping: float = quantity(1.0, "1", "damping of the law computed_torque", gt=0, le=10)
    servo_bandwidth_rad_s: float | None = quantity(
        None, "rad/s", "bandwidth for which `cmmsim check` designs gains of the visual servo", gt=0
    )
    servo_damping: float = quantity(
        0.1, "1", "least damping of the visual servo that `cmmsim check` designs", ge=0, lt=1
    )

    @field_validator("law")
    @classmethod
    def _can_be_found(cls, law: str) -> str:
        check_choice(law, "law", LAWS, ValueError)
        return law
