"""Random snake robots as a hypothesis strategy."""

from hypothesis import strategies as st

from dynsim.compile.protocols import BuildContext
from dynsim.library.plants.snake import Config, build


@st.composite
def robots(draw):
    n_h = draw(st.sampled_from([4, 6, 8]))
    n_b = draw(st.integers(2, 7))
    side = st.sampled_from(["left", "right", "none"])
    sides = draw(st.lists(side, min_size=n_b + 1, max_size=n_b + 1))
    size = st.floats(0.02, 0.4)
    return build(
        Config(
            yaw_joints=n_b + n_h // 2,
            head_joints=n_h,
            link_length_m=draw(size),
            wheel_radius_m=draw(size),
            wheel_gap_m=draw(st.lists(size, min_size=n_b + 1, max_size=n_b + 1)),
            driven_side=sides,
            gripper_length_m=draw(size),
            controlled_point=draw(st.sampled_from(["head", "gripper"])),
        ),
        BuildContext(1.0),
    )
