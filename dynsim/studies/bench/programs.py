"""Names of what is measured, and what all measurements share."""

SCENARIO = "elbow_comparison"
STEP = 1e-3  # MuJoCo's step in the whole job [s]

DYNSIM_FREE, DYNSIM_CONTACTS = "dynsim", "dynsim, 2 contacts"
ABA, CONSTRAINT_DYNAMICS, LCABA = "Pinocchio ABA", "Pinocchio constraintDynamics", "Pinocchio lcaba"
MUJOCO_FREE, MUJOCO_CONTACTS = "MuJoCo mj_step", "MuJoCo mj_step, 2 contacts"
CONTENDERS = (DYNSIM_FREE, DYNSIM_CONTACTS, ABA, CONSTRAINT_DYNAMICS, LCABA, MUJOCO_FREE, MUJOCO_CONTACTS)
"""Of the right-hand side."""

DYNSIM_DOPRI5, DYNSIM_RADAU5 = "dynsim dopri5 rtol 1e-6", "dynsim radau5 rtol 1e-6"
MUJOCO_EULER, MUJOCO_IMPLICIT = "MuJoCo Euler 1 ms", "MuJoCo implicitfast 1 ms"
"""Of the whole job."""
