"""The plant of the braced arm of docs/getting-started.md, for scenarios of tests."""

PLANT = """plant:
  type: serial_arm
  link: {mass_kg: 0.2, length_m: 0.4, damping_N_m_s_per_rad: 0.3, motor: {type: MOTOR}}
  chain:
    - {axis: z, length_m: 0.0}
    - {axis: y, initial_deg: 60}
    - {axis: y, initial_deg: 60}
    - {axis: y, initial_deg: -75}
    - {axis: y, initial_deg: 60}
"""


def plant(motor: str) -> str:
    """Return the section ``plant`` with motors of a type."""
    return PLANT.replace("MOTOR", motor)
