"""Meshes of the bodies of a robot's legs, as a robot file states them.

A mesh is drawn, and it hides stickers from cameras. It has no effect on the motion of the robot.
"""

from typing import Annotated

from pydantic import Field

from dynamics.checks import Length, Place
from dynamics.parameter_set import Strict

ORIGIN = (0.0,) * 6

Pose = Annotated[tuple[Place, ...], Field(min_length=6, max_length=6)]


class BodyMesh(Strict):
    """Closed triangle mesh of a body, in a file of its own."""

    body: str = Field(
        description="body of a leg, such as link1, or kind of body, such as link, for all legs"
    )
    file: str = Field(
        description="STL, OBJ, PLY or GLB file; its path is relative to the robot file"
    )
    scale: Length = Field(1.0, description="length of one unit of the mesh, m: 0.001 for mm")
    pose: Pose = Field(
        ORIGIN,
        description="pose of the mesh in the frame of the body, m and rad; the origin of the frame "
        "is the joint with the body before",
    )
