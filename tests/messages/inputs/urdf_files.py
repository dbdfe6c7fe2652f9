"""URDF files."""

from messages.case import ALL, Calls, Edits

AREA = "URDF files"
ORDER = 25

ROBOT = """\
<?xml version="1.0"?>
<robot name="r"><link name="base"/>
<link name="arm">
<inertial>
<origin xyz="0 0 0.25" rpy="0 0 0"/>
<mass value="4.00"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>
</inertial>
</link>
<joint name="hinge" type="revolute">
<origin xyz="0 0 0.1" rpy="0 0 0"/>
<parent link="base"/><child link="arm"/>
<axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="10" velocity="2"/>
<dynamics damping="0.5" friction="0"/>
</joint>
</robot>
"""
INERTIAL = ROBOT[ROBOT.index("<inertial>") : ROBOT.index("</link>\n<joint")]
MASS, TENSOR = INERTIAL.splitlines()[2:4]
JOINT = '<joint name="{}" type="continuous"><parent link="{}"/><child link="{}"/></joint>'
WELD = JOINT.replace("continuous", "fixed")

TABLES = [
    Edits(
        'dynsim.Model.from_urdf("robot.urdf")',
        {"robot.urdf": ROBOT},
        [
            ("empty file", ALL, ""),
            ("robot without links", ALL, "<robot name='r'/>"),
            ("model of MuJoCo", ALL, "<mujoco/>"),
            ("bytes that are not XML", ALL, "\x00" * 20),
            ("element that is not closed", "</inertial>", ""),
            ("attribute twice", 'value="4.00"', 'value="4.00" value="3"'),
            ("document type", "<robot", '<!DOCTYPE robot SYSTEM "robot.dtd"><robot'),
            ("unknown encoding", '<?xml version="1.0"?>', '<?xml version="1.0" encoding="klingon"?>'),
            ("inertial without a mass", MASS, ""),
            ("inertial without moments", TENSOR, ""),
            ("five moments", ' ixx="0.1"', ""),
            ("mass with a decimal comma", "4.00", "4,00"),
            ("mass of two numbers", "4.00", "1 2"),
            ("mass without a number", "4.00", ""),
            ("hexadecimal mass", "4.00", "0x4"),
            ("infinite mass", "4.00", "inf"),
            ("mass beyond all numbers", "4.00", "1e999"),
            ("negative mass in a file", "4.00", "-4"),
            ("misspelt attribute", 'value="4.00"', 'valeu="4.00"'),
            ("attribute that is like no other", 'value="4.00"', 'weight="4.00"'),
            ("misspelt element", "<origin", "<orign"),
            ("mass outside of its inertial", "<inertial>", f"{MASS}<inertial>"),
            ("inertial in a visual", INERTIAL, f"<visual>{INERTIAL}</visual>"),
            ("two masses", MASS, f'{MASS}\n<mass value="5"/>'),
            ("the same mass twice", MASS, f"{MASS}\n{MASS}"),
            ("moments of both orders that differ", 'ixy="0"', 'ixy="0" iyx="0.1"'),
            ("angles in an axis", '<axis xyz="0 1 0"', '<axis xyz="0 1 0" rpy="0 0 0"'),
            ("commas between numbers", '<axis xyz="0 1 0"', '<axis xyz="0, 1, 0"'),
            ("text after the robot", "</robot>", "</robot>more"),
            ("three problems", MASS, "", 'lower="-1"', 'lower="2"', '"0 1 0"', '"0 0 0"'),
            ("moments that no body can have", 'izz="0.1"', 'izz="0.3"'),
            ("mass as text of its element", '<mass value="4.00"/>', "<mass>4.00</mass>"),
            ("origin of two numbers", '"0 0 0.1"', '"0 0.1"'),
            ("axis of zeros", '"0 1 0"', '"0 0 0"'),
            ("axis without numbers", 'axis xyz="0 1 0"', "axis"),
            ("limits that are swapped", 'lower="-1"', 'lower="2"'),
            ("limit without a velocity", ' velocity="2"', ""),
            ("negative velocity limit", 'velocity="2"', 'velocity="-2"'),
            ("revolute joint without limits", '<limit lower="-1" upper="1" effort="10" velocity="2"/>', ""),
            ("negative damping in a file", 'damping="0.5"', 'damping="-0.5"'),
            ("misspelt joint type", 'type="revolute"', 'type="revolut"'),
            ("joint without a type", ' type="revolute"', ""),
            ("joint without a parent", '<parent link="base"/>', ""),
            ("parent that is not in the file", 'link="base"', 'link="bas"'),
            ("joint without a name", '<joint name="hinge"', "<joint"),
            ("link twice", '<link name="base"/>', '<link name="base"/><link name="arm"/>'),
            ("link that two joints carry", "</robot>", f"{JOINT.format('two', 'base', 'arm')}</robot>"),
            ("loop without a root", "</robot>", f"{JOINT.format('two', 'arm', 'base')}</robot>"),
            ("link that no joint carries", "</robot>", '<link name="loose"/></robot>'),
            ("name with a line end", 'name="arm"', 'name="a&#10;m"'),
            ("name of 201 letters", 'name="arm"', f'name="{"m" * 201}"'),
            ("xacro expression as mass", "4.00", "${m}"),
            ("xacro element", "<inertial>", "<xacro:inertial>"),
            ("only fixed joints", 'type="revolute"', 'type="fixed"'),
            ("planar joint with a limit", 'type="revolute"', 'type="planar"'),
            ("joint that mimics one that does not exist", "<dynamics", '<mimic joint="hing"/><dynamics'),
            ("joint that mimics itself", "<dynamics", '<mimic joint="hinge"/><dynamics'),
            ("moving link without mass", INERTIAL, ""),
            (
                "link with a shape and without mass",
                "</robot>",
                f'<link name="tip"><visual/></link>{JOINT.format("wrist", "arm", "tip")}</robot>'.replace(
                    "continuous", "fixed"
                ),
            ),
            ("file that is too large", ALL, "<robot name='" + "x" * 17_000_000 + "'/>"),
        ],
    ),
    Calls(
        [
            ("file that does not exist", 'dynsim.Model.from_urdf("missing.urdf")'),
            ("folder as URDF file", 'dynsim.Model.from_urdf(".")'),
            ("locked joint that does not exist", 'dynsim.Model.from_urdf("robot.urdf", {"hing": 0.0})'),
            (
                "joint locked at a value that is not a number",
                'dynsim.Model.from_urdf("robot.urdf", {"hinge": math.nan})',
            ),
            ("every joint locked", 'dynsim.Model.from_urdf("robot.urdf", {"hinge": 0.0})'),
            ("joint locked beyond its limits", 'dynsim.Model.from_urdf("robot.urdf", {"hinge": 3.0})'),
        ],
        {"robot.urdf": ROBOT},
        heading="robot.urdf",
    ),
]
