"""Kinds of legs, as functions of the motion of their platform joint A.

A kind of leg defines its geometry and the kinematics of its bodies. Its dynamics follow from these
(`leg.Leg`). RSS is the kind in the paper. All code that depends on the kind of a leg is in this
folder and in robot files.
"""

from dynamics.legs.crank_legs import ParallelogramLeg, RrrLeg, RssLeg, RusLeg
from dynamics.legs.leg import Leg
from dynamics.legs.pss import PssLeg, PusLeg
from dynamics.legs.ups import UpsLeg

AnyLeg = RssLeg | RusLeg | UpsLeg | PssLeg | PusLeg | ParallelogramLeg | RrrLeg

# Kinds of legs by the name that robot files give them.
KINDS: dict[str, type[Leg]] = {
    "rss": RssLeg,
    "rus": RusLeg,
    "ups": UpsLeg,
    "pss": PssLeg,
    "pus": PusLeg,
    "parallelogram": ParallelogramLeg,
    "rrr": RrrLeg,
}
