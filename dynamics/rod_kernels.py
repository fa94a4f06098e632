"""Kernel for the positions of a robot's legs, which a sensor in the loop needs at every frame."""

from dynamics.compiled.kernel import Array, Record, call, entry


@entry
def place_parts(
    kinematics: int,
    placements: int,
    pose: Array,
    fixed: Array,
    tolerance: float,
    drawn: Record,
    buffers: Record,
    ends: Array,
) -> bool:
    """Compute the ends (parts, 2, 3) of the drawn rods at a pose (6,), m, in the axes of the base.

    `kinematics` and `placements` are addresses of functions of the robot. `drawn` and `buffers`
    have the fields of `DrawnParts` and `FunctionBuffers`. `fixed` (6,) has the entries of the pose
    that the platform cannot change, and NaN for the others. Returns False if a leg does not reach
    the pose, or if the pose differs from the fixed entries by more than `tolerance`.
    """
    for i in range(6):
        # a comparison with NaN is never true
        if abs(pose[i] - fixed[i]) > tolerance:
            return False
        buffers.at[i] = buffers.moving[i] = pose[i]
    call(kinematics, buffers.at, buffers.reach)
    for leg in range(buffers.reach.shape[1]):
        if not buffers.reach[1, leg] > 0.0:
            return False
    call(placements, buffers.moving, buffers.placements)
    for part in range(len(ends)):
        row = buffers.placements[drawn.body[part]]
        before = drawn.before[part]
        for i in range(3):
            joint = row[i]
            for j in range(3):
                axis = (
                    (1.0 if i == j else 0.0)
                    if before < 0
                    else buffers.placements[before, 3 + 3 * i + j]
                )
                joint += axis * drawn.offset[part, j] - row[3 + 3 * i + j] * drawn.centre[part, j]
            for end in range(2):
                ends[part, end, i] = joint
                for j in range(3):
                    ends[part, end, i] += row[3 + 3 * i + j] * drawn.ends[part, end, j]
    return True
