"""Positions of the rods of a robot's legs, which a sensor in the loop needs at every frame."""

from dynamics.compiled.kernel import Array, Record, call, entry


@entry
def place_rods(
    kinematics: int,
    placements: int,
    pose: Array,
    held: Array,
    slack: float,
    drawn: Record,
    room: Record,
    ends: Array,
) -> bool:
    """Compute the ends (parts, 2, 3) of the drawn parts at a pose (6,), m, in the axes of the base.

    `kinematics` and `placements` are addresses of functions of the robot. `drawn` and `room` have
    the fields of `DrawnParts` and `FunctionBuffers`. `held` (6,) has the value of each coordinate
    of the pose that the chart fixes to within `slack`, and NaN for the others. Returns False if a
    leg does not reach the pose, or if the pose differs from the fixed coordinates.
    """
    for i in range(6):
        # a comparison with NaN is never true
        if abs(pose[i] - held[i]) > slack:
            return False
        room.at[i] = room.moving[i] = pose[i]
    call(kinematics, room.at, room.reach)
    for leg in range(room.reach.shape[1]):
        if not room.reach[1, leg] > 0.0:
            return False
    call(placements, room.moving, room.placements)
    for part in range(len(ends)):
        own = room.placements[drawn.body[part]]
        before = drawn.before[part]
        for i in range(3):
            joint = own[i]
            for j in range(3):
                axis = (
                    (1.0 if i == j else 0.0)
                    if before < 0
                    else room.placements[before, 3 + 3 * i + j]
                )
                joint += axis * drawn.offset[part, j] - own[3 + 3 * i + j] * drawn.centre[part, j]
            for end in range(2):
                ends[part, end, i] = joint
                for j in range(3):
                    ends[part, end, i] += own[3 + 3 * i + j] * drawn.ends[part, end, j]
    return True
