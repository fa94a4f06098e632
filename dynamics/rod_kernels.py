"""Compiled: where the rods of a robot's legs are, frame after frame, as a sensor in the loop asks for them."""

from dynamics.compiled.kernel import Array, Record, call, entry


@entry
def place_rods(
    kinematics: int, placements: int, pose: Array, held: Array, slack: float, drawn: Record, room: Record, ends: Array
) -> bool:
    """Fill the ends (parts, 2, 3) of what is drawn of each part, base axes, m, with the platform at a pose (6,); False
    where a leg does not reach, or the platform cannot be there.

    kinematics, placements: addresses of a robot's functions. drawn, room: `Drawn` and `Room`. held (6,): what its chart
    lets no platform change, by no more than the slack; NaN elsewhere.
    """
    for i in range(6):
        if abs(pose[i] - held[i]) > slack:  # never where that is NaN
            return False
        room.at[i] = room.moving[i] = pose[i]
    call(kinematics, room.at, room.reach)
    for leg in range(room.reach.shape[1]):
        if not room.reach[1, leg] > 0.0:
            return False
    call(placements, room.moving, room.placements)
    for part in range(len(ends)):
        own, before = room.placements[drawn.body[part]], drawn.before[part]
        for i in range(3):
            joint = own[i]
            for j in range(3):
                axis = (1.0 if i == j else 0.0) if before < 0 else room.placements[before, 3 + 3 * i + j]
                joint += axis * drawn.offset[part, j] - own[3 + 3 * i + j] * drawn.centre[part, j]
            for end in range(2):
                ends[part, end, i] = joint
                for j in range(3):
                    ends[part, end, i] += own[3 + 3 * i + j] * drawn.ends[part, end, j]
    return True
