"""Kinds of legs: what a leg does as a function of the motion of its platform joint A alone.

A kind has its geometry, the kinematics of its bodies, and with those its dynamics (`leg.Leg`). RSS is the one of the
paper's robot. All that knows which leg it is stands in this room and in robot files.
"""

from dynamics.legs.leg import Leg
from dynamics.legs.pss import PssLeg, PusLeg
from dynamics.legs.rss import ParallelogramLeg, RrrLeg, RssLeg
from dynamics.legs.rus import RusLeg
from dynamics.legs.ups import UpsLeg

AnyLeg = RssLeg | RusLeg | UpsLeg | PssLeg | PusLeg | ParallelogramLeg | RrrLeg

KINDS: dict[str, type[Leg]] = {
    "rss": RssLeg,
    "rus": RusLeg,
    "ups": UpsLeg,
    "pss": PssLeg,
    "pus": PusLeg,
    "parallelogram": ParallelogramLeg,
    "rrr": RrrLeg,
}
"""Kinds of legs by the name that robot files give them."""
