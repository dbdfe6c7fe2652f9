"""The Python interface: models, robots, braces, and arguments of its functions."""

from messages.case import Calls

AREA = "Python: models and arguments"
ORDER = 100

ORIGIN = "[0, 0, 0]"
PLAIN = "Robot('arm', (BODY,), (), ('body', np.zeros(3)))"
BRACE = "dynsim.Brace('link_4', [0, 0, 0]"
ROBOT = "Robot('arm', (replace(BODY, {}),), (), ('body', np.zeros(3)))"

TABLES = [
    Calls(
        [
            ("index of a body that is too large", f"model.point_position(10, {ORIGIN}, np.zeros(10))"),
            ("negative index of a body", f"model.point_jacobian(-1, {ORIGIN}, np.zeros(10))"),
            ("body that does not exist", "model.body_pose('link_11', np.zeros(10))"),
            ("None as body", "model.body_pose(None, np.zeros(10))"),
            ("text as joint angles", "model.mass_matrix('upright')"),
            ("None as joint angles", "model.mass_matrix(None)"),
            ("complex joint angles", "model.mass_matrix(np.zeros(10) + 1j)"),
            ("nested joint angles", "model.mass_matrix([[0.0], [0.0, 1.0]])"),
            ("too few joint angles", "model.mass_matrix(np.zeros(9))"),
            ("joint angle that is not a number", "model.mass_matrix([0.0] * 9 + [math.nan])"),
            ("infinite rates", "model.bias_forces(np.zeros(10), np.full(10, -math.inf))"),
            ("too few accelerations", "model.inverse_dynamics(np.zeros(10), np.zeros(10), [1.0])"),
            ("too few torques", "model.forward_dynamics(np.zeros(10), np.zeros(10), [1.0])"),
            ("text as point", "model.point_position(0, 'tip', np.zeros(10))"),
            ("point of two coordinates", "model.point_position(0, [0.1, 0.2], np.zeros(10))"),
            ("point that is not a number", "model.point_position(0, [0.0, math.nan, 0.0], np.zeros(10))"),
            ("orientation that is not a rotation", "model.inverse_kinematics([1, 1, 0.4], orientation=np.eye(3) * 2)"),
            ("position that no posture reaches", "model.inverse_kinematics([9, 9, 9])"),
            ("model of a name", "dynsim.Model('elbow_comparison')"),
            ("None as URDF file", "dynsim.Model.from_urdf(None)"),
            ("build_model of a name", "dynsim.build_model('elbow_comparison')"),
            ("model of a kinematic snake", "dynsim.build_model(dynsim.load_scenario('snake_operator'))"),
        ],
        heading="models",
    ),
    Calls(
        [
            ("axis of two numbers", f"dynsim.Model({ROBOT.format('axis=np.zeros(2)')})"),
            ("axis that is not a unit vector", f"dynsim.Model({ROBOT.format('axis=np.array([0.0, 0.0, 2.0])')})"),
            ("matrix that is not a rotation", f"dynsim.Model({ROBOT.format('R_PJ=np.eye(3) * 2')})"),
            ("position that is not a number", f"dynsim.Model({ROBOT.format('p_PJ=np.full(3, math.nan)')})"),
            ("text as mass", f"dynsim.Model({ROBOT.format('inertia=Inertia(chr(49))')})"),
            ("negative mass", f"dynsim.Model({ROBOT.format('inertia=Inertia(-1.0)')})"),
            ("negative damping", f"dynsim.Model({ROBOT.format('damping=-1.0')})"),
            ("kind of joint that does not exist", f"dynsim.Model({ROBOT.format('kind=chr(120)')})"),
            ("parent that does not exist", f"dynsim.Model({ROBOT.format('parent=chr(120)')})"),
            ("robot without links", "dynsim.Model(Robot('arm', (), (), ('body', np.zeros(3))))"),
            ("robot with a link twice", "dynsim.Model(Robot('arm', (BODY, BODY), (), ('body', np.zeros(3))))"),
            (
                "hand on a body that does not exist,",
                "dynsim.Model(Robot('arm', (BODY,), (), ('tip', np.zeros(3))))",
            ),
            (
                "gravity of one number",
                f"dynsim.Model(replace({PLAIN}, gravity=9.81))",
            ),
            (
                "joints that lead each other",
                f"dynsim.Model(replace({PLAIN}, couplings=(Coupling('hinge', 'hinge'),)))",
            ),
            (
                "coupling of a joint that does not exist",
                f"dynsim.Model(replace({PLAIN}, couplings=(Coupling('hinge', 'joint'),)))",
            ),
        ],
        heading="robots built in Python",
    ),
    Calls(
        [
            ("brace without a normal", f"{BRACE}, [0, 0, 0])"),
            ("brace with a text as normal", f"{BRACE}, 'up')"),
            ("brace with a point of two coordinates", "dynsim.Brace('link_4', [0, 0], [0, 0, 1])"),
            ("brace with negative friction", f"{BRACE}, [0, 0, 1], friction=-0.1)"),
            ("brace that pulls", f"{BRACE}, [0, 0, 1], normal_force=-3.0)"),
            ("brace with a negative least force", f"{BRACE}, [0, 0, 1], min_N=-1.0)"),
            ("brace that slides into its surface", f"{BRACE}, [0, 0, 1], sliding=[0, 0, 1])"),
            (
                "brace on a body that does not exist",
                f"model.brace_statics(*np.zeros((3, 10)), {{'toe': {BRACE.replace('link_4', 'link_44')}, [0, 0, 1])}})",
            ),
        ],
        heading="braces",
    ),
    Calls(
        [
            ("check of a name", "dynsim.check('elbow_comparison')"),
            ("simulation of a name", "dynsim.simulate('single_pendulum')"),
            ("comparison in no processes", "dynsim.compare('elbow_comparison', jobs=0)"),
            ("comparison in processes that are a text", "dynsim.compare('elbow_comparison', jobs='2')"),
            ("comparison of a scenario without variants", "dynsim.compare('single_pendulum')"),
            ("batch in no processes", "dynsim.simulate_batch([arm], jobs=0)"),
            ("batch that keeps some records", "dynsim.simulate_batch([arm], keep_records='some')"),
            ("batch of a name", "dynsim.simulate_batch(['elbow_comparison'])"),
            (
                "export of wheels to URDF",
                "dynsim.build_model(dynsim.load_scenario('mobile_elbow_comparison')).to_urdf()",
            ),
            (
                "export of wheels to MuJoCo",
                "dynsim.build_model(dynsim.load_scenario('mobile_elbow_comparison')).to_mjcf()",
            ),
            ("file without a record", "dynsim.Record.load('none.h5')"),
        ],
        heading="functions",
    ),
]
