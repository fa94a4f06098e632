"""What a robot file leaves open of its bodies and joints, as standard deviations about its model.

The model of a centred body has its centre of mass in one place, and its axes of inertia along its
own axes. The model of a passive joint without friction parameters turns freely. Real bodies and
joints are near this, and how near is a statement of the file.
"""

from pydantic import Field

from dynamics.checks import Damping
from dynamics.parameter_set import Strict


class Unstated(Strict):
    """Standard deviations of what the parameters of a robot do not state.

    They apply to centred bodies, and to passive joints without a viscous parameter. The defaults
    are those of an ordinary workshop. Zero states that bodies and joints are exactly as the model
    has them.
    """

    centre_std: float = Field(
        0.03,
        description="of each coordinate of a centre of mass, as a share of the length of the body",
        ge=0,
        le=1,
    )
    product_std: float = Field(
        0.05,
        description="of each product of inertia, as a share of the body's mean moment of inertia",
        ge=0,
        le=1,
    )
    passive_viscous_std: Damping = Field(
        0.005, description="of the viscous friction of a passive joint, N m s/rad"
    )


EXACT = Unstated(centre_std=0.0, product_std=0.0, passive_viscous_std=0.0)
"""Bodies and joints that are exactly as the model has them."""
