"""Contacts, surfaces, and the start on them."""

from messages.case import Edits, Overrides

AREA = "Contacts and surfaces"
ORDER = 30

ARM = """\
duration_s: 0.05
plant:
  type: serial_arm
  base: {position_m: [0, 0, 0.3]}
  chain: [{axis: z, motor: {type: wang_minami}}, {axis: y, count: 3, length_m: 0.2, motor: {type: wang_minami}}]
metrics: {settle_s: 0.01}
surfaces:
  floor: {type: plane}
  thing: {type: plane, point_m: [0, 0, -5]}
contacts:
  law: unilateral
  points:
    elbow: {body: link_3}
controller: {type: joint_pd}
integrator: {method: auto}
"""
STANDING = """\
duration_s: 1
plant: {type: serial_arm, chain: [{axis: y, initial_deg: 90}]}
surfaces: {floor: {type: plane}}
contacts:
  points:
    tip:
      body: link_1
      point_m: [0, 0, 0.3]
      surface: floor
"""
TOUCHING = """\
duration_s: 0.05
plant: {type: serial_arm, chain: [{axis: y, count: 3, length_m: 0.2, radius_m: 0.02}, {axis: y, length_m: 0.1}]}
objects:
  box: {mass_kg: 1, size_m: [0.1, 0.1, 0.1], position_m: [0.5, 0, 0.1]}
  crate: {mass_kg: 1, size_m: [0.1, 0.1, 0.1], position_m: [0.5, 0, 0.3]}
contacts: {law: unilateral, between: [{bodies: [links, box]}]}
integrator: {method: time_stepping}
metrics: {settle_s: 0.01}
"""
CHECK = 'dynsim.check(dynsim.load_scenario("arm.yaml"))'
THING = "{type: plane, point_m: [0, 0, -5]}"
HEIGHTS = "0,0,0\n0,0,0\n0,0,0\n"
FIELD = ARM.replace(THING, "{type: height_field, file: heights.csv, spacing_m: [0.1, 0.1]}")

TABLES = [
    Edits(
        CHECK,
        {"arm.yaml": ARM},
        [
            ("misspelt key of contacts", "law: unilateral", "lew: unilateral"),
            ("unknown law", "law: unilateral", "law: glued"),
            ("negative friction", "law: unilateral", "law: unilateral\n  friction: -0.1"),
            ("text as friction", "law: unilateral", "law: unilateral\n  friction: rough"),
            (
                "static friction below the kinetic one",
                "law: unilateral",
                "law: unilateral\n  friction: 0.5\n  static_friction: 0.2",
            ),
            (
                "static friction of a point below its kinetic one",
                "{body: link_3}",
                "{body: link_3, friction: 0.5, static_friction: 0.2}",
            ),
            ("restitution above one", "law: unilateral", "law: unilateral\n  restitution: 2"),
            (
                "restitution under the bilateral law",
                "law: unilateral",
                "law: bilateral",
                "{body: link_3}",
                "{body: link_3, restitution: 0.3}",
            ),
            (
                "smoothed slip under the unilateral law",
                "law: unilateral",
                "law: unilateral\n  slip_smoothing_m_s: 0.001",
            ),
            (
                "pulling friction under the unilateral law",
                "law: unilateral",
                "law: unilateral\n  pulling_friction: signed",
            ),
            ("Stribeck speed of zero", "law: unilateral", "law: unilateral\n  stribeck_m_s: 0"),
            ("unknown candidates", "law: unilateral", "law: unilateral\n  candidates: bodies"),
            ("candidates under the bilateral law", "law: unilateral", "law: bilateral\n  candidates: links"),
            (
                "compliant contact without time stepping",
                "law: unilateral",
                "law: unilateral\n  stiffness_N_per_m: 1.0e+5",
            ),
            (
                "compliant contact with restitution",
                "law: unilateral",
                "law: unilateral\n  stiffness_N_per_m: 1.0e+5\n  restitution: 0.3",
                "method: auto",
                "method: time_stepping",
            ),
            (
                "damping without stiffness",
                "law: unilateral",
                "law: unilateral\n  damping_N_s_per_m: 100",
                "method: auto",
                "method: time_stepping",
            ),
            ("grip without time stepping", "{body: link_3}", "{body: link_3, grip: {axis: [1, 0, 0], ratio: 0.1}}"),
            ("grip without direction", "{body: link_3}", "{body: link_3, grip: {axis: [0, 0, 0], ratio: 0.1}}"),
            ("misspelt key of a point", "{body: link_3}", "{bdy: link_3}"),
            ("point on a body that does not exist", "{body: link_3}", "{body: link_33}"),
            ("point on a surface that does not exist", "{body: link_3}", "{body: link_3, surface: flor}"),
            ("point of two coordinates", "{body: link_3}", "{body: link_3, point_m: [0, 0]}"),
            (
                "contacts without surfaces",
                "surfaces:\n  floor: {type: plane}\n  thing: {type: plane, point_m: [0, 0, -5]}\n",
                "",
            ),
            ("points in a list", "points:\n    elbow: {body: link_3}", "points: [{body: link_3}]"),
            ("surface without a type", "floor: {type: plane}", "floor: {typ: plane}"),
            ("unknown surface", "floor: {type: plane}", "floor: {type: plain}"),
            (
                "key of another surface",
                "floor: {type: plane}",
                "floor: {type: sphere, center_m: [0, 0, -1], normal: [0, 0, 1]}",
            ),
            ("normal without direction", "floor: {type: plane}", "floor: {type: plane, normal: [0, 0, 0]}"),
            (
                "cylinder without radius",
                "floor: {type: plane}",
                "floor: {type: cylinder, point_m: [0, 0, 0], axis: [1, 0, 0]}",
            ),
            (
                "sphere of radius zero",
                "floor: {type: plane}",
                "floor: {type: sphere, center_m: [0, 0, -1], radius_m: 0}",
            ),
            ("box with a negative edge", THING, "{type: box, center_m: [0, 0, -5], edges_m: [1, -1, 1]}"),
            ("box of two edges", THING, "{type: box, center_m: [0, 0, -5], edges_m: [1, 1]}"),
            (
                "box that is rounded too much",
                THING,
                "{type: box, center_m: [0, 0, -5], edges_m: [1, 1, 0.4], edge_radius_m: 0.3}",
            ),
            (
                "heights in a file that does not exist",
                THING,
                "{type: height_field, file: none.csv, spacing_m: [0.1, 0.1]}",
            ),
            ("surface error with a negative factor", "surface_error: {friction_factor: -1}\n"),
            ("theta below one half", "method: auto", "method: time_stepping, theta: 0.3"),
            ("theta without time stepping", "method: auto", "method: auto, theta: 0.7"),
            ("dense solver with time stepping", "method: auto", "method: time_stepping, solver: m_star"),
            (
                "time stepping under the bilateral law",
                "law: unilateral",
                "law: bilateral",
                "method: auto",
                "method: time_stepping",
            ),
            ("no point on a surface at the start", "initial: {on_surface: []}\n"),
            ("text as points on a surface", "initial: {on_surface: elbow}\n"),
            ("point on a surface that is not a contact", "initial: {on_surface: [elbo]}\n"),
            ("kept joint that does not exist", "initial: {on_surface: [elbow], keep: [arm]}\n"),
            ("kept joint without points on a surface", "initial: {equilibrium: true, keep: [hand]}\n"),
            ("start on references that do not move", "initial: {on_references: true}\n"),
            (
                "start that no joint can bring to the surface",
                "initial: {on_surface: [elbow], keep: [joint_1, joint_2, joint_3, joint_4]}\n",
            ),
            (
                "start on the far side of a box, through which the arm passes",
                "{axis: y, count: 3, length_m: 0.2,",
                "{axis: y, length_m: 0.2, initial_deg: 170, limit_deg: [165, 170], motor: {type: wang_minami}}, "
                "{axis: y, count: 2, length_m: 0.2,",
                THING,
                "{type: box, center_m: [0, 0, 0.43], edges_m: [2, 2, 0.05]}",
                "{body: link_3}",
                "{body: link_3, surface: thing}",
                "integrator: {method: auto}",
                "initial: {on_surface: [elbow]}",
            ),
            (
                "equilibrium that the motors cannot hold",
                "{axis: y, count: 3, length_m: 0.2, motor: {type: wang_minami}}",
                "{axis: y, count: 3, length_m: 0.2, initial_deg: 30, motor: {type: wang_minami, voltage_limit_V: 1}}",
                "integrator: {method: auto}",
                "initial: {equilibrium: true}",
            ),
        ],
    ),
    Edits(
        CHECK,
        {"arm.yaml": TOUCHING},
        [
            ("pair with a body that does not exist", "[links, box]", "[links, bocks]"),
            ("pair of one body", "[links, box]", "[box]"),
            ("ignored pair of one body", "{bodies: [links, box]}", "{bodies: [links, box], ignore: [[link_1]]}"),
            (
                "ignored pair that is not in its entry",
                "{bodies: [links, box]}",
                "{bodies: [links, box], ignore: [[link_1, crate]]}",
            ),
            ("entry without pairs", "[links, box]", "[link_1, link_2]"),
            (
                "further contact of a pair on its surface",
                "integrator:",
                "initial: {on_surface: [link_4-box_2]}\nintegrator:",
            ),
            ("bodies that overlap at the start", "[0.5, 0, 0.1]", "[0.05, 0, 0.1]"),
            (
                "links that overlap at the start",
                "[links, box]",
                "[links, links]",
                "count: 3,",
                "count: 3, initial_deg: 170,",
            ),
            (
                "bodies that touch under the bilateral law",
                "law: unilateral",
                "law: bilateral",
                "time_stepping",
                "dopri5",
            ),
            ("too many contacts for events", "[links, box]", "[crate, box]", "time_stepping", "dopri5"),
            (
                "surface on a body that does not exist",
                "contacts:",
                "surfaces: {top: {type: plane, on: link_9}}\ncontacts:",
            ),
        ],
    ),
    Edits(
        CHECK,
        {"arm.yaml": STANDING},
        [
            ("point that starts above its surface", "initial_deg: 90", "initial_deg: 80"),
            ("point that starts below its surface", "initial_deg: 90", "initial_deg: 100"),
            ("point fixed to the world", "body: link_1", "body: base"),
        ],
    ),
    Edits(
        CHECK,
        {"arm.yaml": FIELD, "heights.csv": HEIGHTS},
        [
            ("row of another length", "0,0,0\n0,0,0\n0,0,0\n", "0,0,0\n0,0\n0,0,0\n"),
            ("text as height", "0,0,0\n0,0,0\n0,0,0\n", "0,0,0\n0,up,0\n0,0,0\n"),
            ("heights without rows", "0,0,0\n0,0,0\n0,0,0\n", "\n"),
            ("heights in a single row", "0,0,0\n0,0,0\n0,0,0\n", "0,0,0\n"),
        ],
        keyed=False,
    ),
    Overrides(
        "elbow_comparison",
        [
            ("elbow that starts above the floor", {"plant.initial_deg.1": 40}),
            ("surface at another height", {"surfaces.floor.point_m": [0, 0, 0.05]}),
            (
                "reference that pulls an elbow off the floor",
                {"controller.hand.joints": ["joint_1", "joint_2", "joint_9", "joint_10"]},
            ),
            ("elbows of an arm that is too short", {"plant.chain.0.length_m": 0.02}),
        ],
    ),
]
