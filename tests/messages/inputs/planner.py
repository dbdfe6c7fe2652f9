"""The planner of braces."""

from messages.case import Calls, Commands

AREA = "Planner"
ORDER = 140

TABLES = [
    Commands(
        [
            ("numbers of braces that are texts", "plan elbow_comparison --count many"),
            ("more braces at least than at most", "plan elbow_comparison --count 3:1"),
            ("negative number of braces", "plan elbow_comparison --count -1"),
            ("numbers of phases that are texts", "plan elbow_comparison --phases many"),
            ("no phases", "plan elbow_comparison --phases 0:2"),
            ("weight of something else", "plan elbow_comparison --weight mean=0.5"),
            ("negative weight", "plan elbow_comparison --weight peak=-1"),
            ("gains that are texts", "plan elbow_comparison --gains high,low"),
            ("gains of zero", "plan elbow_comparison --gains 0,1"),
            ("candidates that name nothing", "plan elbow_comparison --candidates ,"),
            ("candidate that does not exist", "plan elbow_comparison --candidates elbow_44 --no-verify"),
            (
                "candidates from the end to the beginning",
                "plan elbow_comparison --candidates link_7:link_4 --no-verify",
            ),
            ("range of links that do not exist", "plan elbow_comparison --candidates link_4:link_44 --no-verify"),
            ("surface that does not exist", "plan elbow_comparison --surface roof --no-verify"),
            ("share beyond the end of a link", "plan elbow_comparison --along 1.5 --no-verify"),
            ("plan of an arm without a path", "plan single_pendulum --no-verify"),
            ("plan of a snake", "plan snake_operator --no-verify"),
            ("plan into a file", "plan elbow_comparison --out file"),
            ("requirement that does not exist", "plan bench_arm --require hand_sag=0.001"),
            ("requirement without a value", "plan bench_arm --require rating_share"),
            ("sag without a force", "plan pressing --require hand_sag_m=0.001"),
            ("force without a sag", "plan pressing --require hand_force_N=[0,0,-9]"),
            ("error of a payload that is not there", "plan pressing --require payload_error=0.1"),
            ("rating without rated motors", "plan pressing --require rating_share=1 --no-verify"),
            ("range without numbers", "plan bench_arm --vary contacts.friction=low:high"),
            ("value without numbers", "plan bench_arm --vary contacts.law=unilateral,bilateral"),
            (
                "three varied keys",
                "plan bench_arm --vary contacts.friction=0:1 --vary duration_s=1:2 --vary loads.tool.mass_kg=1:2",
            ),
            ("varied key that is set", "plan bench_arm --vary contacts.friction=0:1 --set contacts.friction=0.2"),
            ("varied key that does not exist", "plan bench_arm --vary contacts.slip=0:1"),
        ],
        {"file": ""},
    ),
    Calls(
        [
            ("negative radius", "dynsim.plan_braces(arm, radius_m=-0.1, verify=False)"),
            ("no random starts", "dynsim.plan_braces(arm, starts=0, verify=False)"),
            ("seed below zero", "dynsim.plan_braces(arm, seed=-1, verify=False)"),
            ("budget below zero", "dynsim.plan_braces(arm, budget_s=-1.0, verify=False)"),
            ("plan in no processes", "dynsim.plan_braces(arm, jobs=0, verify=False)"),
            ("plan of a name", "dynsim.plan_braces('elbow_comparison')"),
            (
                "plan without gravity",
                "dynsim.plan_braces(dynsim.load_scenario('elbow_comparison',"
                " overrides={'plant.gravity_m_s2': [0, 0, 0]}), verify=False)",
            ),
            (
                "plan without surfaces",
                "dynsim.plan_braces(dynsim.load_scenario('elbow_comparison',"
                " 'no_elbow', {'surfaces': {}, 'contacts': {}}), verify=False)",
            ),
            (
                "more braces than points",
                "dynsim.plan_braces(arm, candidates=['elbow_4'], count=(3, 3), verify=False)",
            ),
            (
                "plan next to an object",
                "dynsim.plan_braces(dynsim.load_scenario('pressing', 'plain', {'objects.box': {'mass_kg': 1,"
                " 'size_m': [0.1, 0.1, 0.1], 'position_m': [2, 2, 2]}}), starts=1, count=(0, 0), verify=False,"
                " budget_s=0)",
            ),
            (
                "motors without a winding",
                "dynsim.plan_braces(dynsim.load_scenario('elbow_comparison', overrides="
                "{'plant.link.motor': {'type': 'torque', 'limit_N_m': 1}}), verify=False)",
            ),
        ]
    ),
]
