"""Names of the measured programs, and helpers shared by all benchmarks."""

SCENARIO = "elbow_comparison"
STEP = 1e-3  # step of MuJoCo in the whole job [s]

DYNSIM_FREE, DYNSIM_CONTACTS = "dynsim", "dynsim, 2 contacts"
ABA, CONSTRAINT_DYNAMICS, LCABA = "Pinocchio ABA", "Pinocchio constraintDynamics", "Pinocchio lcaba"
MUJOCO_FREE, MUJOCO_CONTACTS = "MuJoCo mj_step", "MuJoCo mj_step, 2 contacts"
SAME_TASK = {
    ABA: DYNSIM_FREE,
    CONSTRAINT_DYNAMICS: DYNSIM_CONTACTS,
    LCABA: DYNSIM_CONTACTS,
    MUJOCO_FREE: DYNSIM_FREE,
    MUJOCO_CONTACTS: DYNSIM_CONTACTS,
}
"""Right-hand side: programs, and the measurement of dynsim for the same task."""
RIGHT_HAND_SIDES = (DYNSIM_FREE, DYNSIM_CONTACTS, *SAME_TASK)

DYNSIM_RADAU5 = "dynsim radau5 rtol 1e-6"
MUJOCO_EULER, MUJOCO_IMPLICIT = "MuJoCo Euler 1 ms", "MuJoCo implicitfast 1 ms"
JOBS = (DYNSIM_RADAU5, MUJOCO_EULER, MUJOCO_IMPLICIT)
"""Programs that simulate the whole run."""
