"""Plants: serial arms, arms from URDF, mobile bases, and their motors."""

from messages.case import Edits, Overrides

AREA = "Plants and motors"
ORDER = 20

MOTOR = """\
type: dc
torque_constant_N_m_per_A: 0.1
resistance_ohm: 0.5
inductance_H: 0.0005
rotor_inertia_kg_m2: 5.0e-5
gear_ratio: 100
voltage_limit_V: 48"""
ARM = """\
duration_s: 0.1
plant:
  type: serial_arm
  link:
    mass_kg: 0.2
    motor: {type: wang_minami}
  chain:
    - {axis: z, length_m: 0}
    - {axis: y, count: 2, length_m: 0.3}
  initial_deg: [0, 30, 60]
"""
RAIL = """\
duration_s: 0.1
plant:
  type: serial_arm
  chain:
    - {kind: prismatic, axis: x, length_m: 0, limit_m: [-1, 1]}
    - {axis: y, length_m: 0.3, limit_deg: [-90, 90]}
"""
DC = f"""\
duration_s: 0.1
plant:
  type: serial_arm
  chain:
    - axis: y
      motor:
{"".join(f"        {line}{chr(10)}" for line in MOTOR.splitlines())}"""
CHECK = 'dynsim.check(dynsim.load_scenario("arm.yaml"))'

TABLES = [
    Edits(
        CHECK,
        {"arm.yaml": ARM},
        [
            ("misspelt key of every link", "mass_kg", "mas_kg"),
            ("misspelt key of a link", "length_m: 0.3", "lenght_m: 0.3"),
            ("negative mass", "mass_kg: 0.2", "mass_kg: -0.2"),
            ("text as mass", "mass_kg: 0.2", "mass_kg: heavy"),
            ("unknown axis", "axis: z", "axis: w"),
            ("axis without direction", "axis: z", "axis: [0, 0, 0]"),
            ("axis of two numbers", "axis: z", "axis: [0, 1]"),
            ("no links of a kind", "count: 2", "count: 0"),
            ("half a link", "count: 2", "count: 2.5"),
            ("very many links", "count: 2", "count: 200000", "  initial_deg: [0, 30, 60]\n", ""),
            ("too few initial angles", "[0, 30, 60]", "[0, 30]"),
            ("initial angle that is text", "[0, 30, 60]", "[0, 30, up]"),
            ("initial angles of an arm with a rail", "{axis: z, length_m: 0}", "{kind: prismatic, axis: z}"),
            (
                "shared key that every link replaces",
                "length_m: 0}",
                "length_m: 0, mass_kg: 1}",
                "length_m: 0.3}",
                "length_m: 0.3, mass_kg: 1}",
            ),
            ("loss of a rail on hinges", "mass_kg: 0.2", "damping_N_s_per_m: 1"),
            ("negative damping", "mass_kg: 0.2", "damping_N_m_s_per_rad: -1"),
            ("motor without inductance", "{type: wang_minami}", "{type: wang_minami, inductance_H: 0}"),
            ("negative inductance", "{type: wang_minami}", "{type: wang_minami, inductance_H: -1}"),
            ("unknown motor", "{type: wang_minami}", "{type: wang_minamy}"),
            ("motor as text", "motor: {type: wang_minami}", "motor: wang_minami"),
            ("unknown key of a motor", "{type: wang_minami}", "{type: wang_minami, voltage: 3}"),
            ("gravity of one number", "  initial_deg", "  gravity_m_s2: 9.81\n  initial_deg"),
            ("base as a number", "  initial_deg", "  base: 1\n  initial_deg"),
            ("unknown key of the base", "  initial_deg", "  base: {yaw: 45}\n  initial_deg"),
            ("inertia that no body can have", "mass_kg: 0.2", "inertia_kg_m2: [1, 0, 0, 1, 0, 3]"),
        ],
    ),
    Edits(
        CHECK,
        {"arm.yaml": RAIL},
        [
            ("limits of a rail that are swapped", "[-1, 1]", "[1, -1]"),
            ("limits of a hinge that are swapped", "[-90, 90]", "[90, -90]"),
            ("angle of a rail", "limit_m: [-1, 1]", "initial_deg: 10"),
            ("distance of a hinge", "limit_deg: [-90, 90]", "initial_m: 0.1"),
            ("damping of a hinge on a rail", "limit_m: [-1, 1]", "damping_N_m_s_per_rad: 1"),
            (
                "start beyond a stop",
                "limit_deg: [-90, 90]}",
                "limit_deg: [-90, 90], initial_deg: 95}\ncontacts: {law: unilateral}",
            ),
            ("dry friction under the bilateral law", "limit_deg: [-90, 90]}", "friction_N_m: 0.2}"),
            ("joint that moves no mass", "length_m: 0.3, limit_deg: [-90, 90]", "mass_kg: 0"),
            ("initial angle of very many turns", "limit_deg: [-90, 90]", "initial_deg: 1.0e+20"),
            ("kind of joint that is not known", "kind: prismatic", "kind: ball"),
        ],
    ),
    Edits(
        CHECK,
        {"arm.yaml": DC},
        [
            ("motor without its torque constant", "        torque_constant_N_m_per_A: 0.1\n", ""),
            ("resistance of zero", "resistance_ohm: 0.5", "resistance_ohm: 0"),
            ("gear ratio of zero", "gear_ratio: 100", "gear_ratio: 0"),
            (
                "peak current below the nominal one",
                "voltage_limit_V: 48",
                "voltage_limit_V: 48\n        nominal_current_A: 4\n        peak_current_A: 2",
            ),
            (
                "position of a motor without mass",
                "voltage_limit_V: 48",
                "voltage_limit_V: 48\n        mass_point_m: [0, 0, 0]",
            ),
            (
                "stiff motor with explicit steps",
                "inductance_H: 0.0005",
                "inductance_H: 1.0e-9",
                "duration_s: 0.1",
                "duration_s: 10\nintegrator: {method: dopri5}",
            ),
        ],
    ),
    Overrides(
        "six_axis_arm",
        [
            ("URDF file that does not exist", {"plant.file": "robots/six_axis.urdf"}),
            ("number as URDF file", {"plant.file": 3}),
            ("lock of a joint that does not exist", {"plant.lock_deg": {"elbow": 0}}),
            ("start of a joint that does not exist", {"plant.initial_deg.elbow": 10}),
            ("distance as start of a hinge", {"plant.initial_m": {"elbow_pitch": 0.1}}),
            ("motor of a joint that does not exist", {"plant.motors": {"elbow": {"type": "wang_minami"}}}),
            ("hand on a body that does not exist", {"plant.hand": {"body": "flansh"}}),
            ("hand on a fixed body", {"plant.hand": {"body": "base"}}),
            ("hand of two coordinates", {"plant.hand": {"body": "flange", "point_m": [0, 0]}}),
            ("pose of a joint that is a hinge", {"plant.initial_pose": {"elbow_pitch": {"position_m": [0, 0, 0]}}}),
            ("correction of a link that does not exist", {"plant.links": {"wrst": {"mass_kg": 1}}}),
            ("correction of a joint that does not exist", {"plant.joints": {"elbow": {"damping": 1}}}),
            ("limit in metres of a hinge", {"plant.joints": {"elbow_pitch": {"limit_m": [0, 1]}}}),
            ("density and mass of a link", {"plant.links": {"forearm": {"mass_kg": 1, "density_kg_m3": 1000}}}),
            ("radius of a link that is fixed to another", {"plant.links": {"gripper": {"radius_m": 0.02}}}),
            (
                "pair with a link that is fixed to another",
                {"contacts": {"law": "unilateral", "between": [{"bodies": ["gripper", "links"]}]}},
            ),
            ("impossible moments of a link", {"plant.links": {"forearm": {"inertia_kg_m2": [1, 0, 0, 1, 0, 3]}}}),
            ("base that moves otherwise", {"plant.base": "mobile"}),
            ("motor without inductance of an arm from URDF", {"plant.motor.inductance_H": 0}),
            (
                "start beyond the limits of the file",
                {"plant.initial_deg.elbow_pitch": 170, "contacts.law": "unilateral"},
            ),
        ],
    ),
    Overrides(
        "mobile_elbow_comparison_driving",
        [
            ("track of zero", {"plant.base.track_m": 0}),
            (
                "wheel of no real inertia",
                {"plant.base.wheel.inertia_axle_kg_m2": 9, "plant.base.wheel.inertia_across_kg_m2": 1},
            ),
            ("caster above the floor", {"plant.base.caster_m": [0.15, 0, 0.1]}),
            ("caster on the axle", {"plant.base.caster_m": [0, 0, 0]}),
            ("base of an arm on a mobile base", {"plant.arm.base": {"yaw_deg": 10}}),
            ("unknown on_overturn", {"plant.base.on_overturn": "fall"}),
            ("base of no real inertia", {"plant.base.inertia_kg_m2": [0.03, 0, 0, 0.05, 0, 0.6]}),
            ("wheels without motors", {"plant.base.wheel.motor": None}),
            (
                "mobile base with time stepping",
                {"integrator.method": "time_stepping", "contacts": {"law": "unilateral"}},
            ),
        ],
    ),
]
