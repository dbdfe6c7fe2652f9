"""Scenario files: YAML, keys and values, variants, overrides."""

from messages.case import ALL, Calls, Edits, Settings

AREA = "Scenario files"
ORDER = 10

ARM = """\
name: arm
duration_s: 1
plant:
  type: serial_arm
  link: {mass_kg: 0.2}
  chain: [{axis: y}]
"""
VARIANTS = f"{ARM}variants:\n  light: {{plant: {{link: {{mass_kg: 0.1}}}}}}\n  heavy: {{}}\n"
CHECK = 'dynsim.check(dynsim.load_scenario("arm.yaml"))'

TABLES = [
    Edits(
        CHECK,
        {"arm.yaml": ARM},
        [
            ("an empty file", ALL, ""),
            ("a list instead of a mapping", ALL, "- 1\n- 2\n"),
            ("a single value", ALL, "arm\n"),
            ("brackets that do not close", "[{axis: y}]", "[{axis: y}"),
            ("a key twice", "duration_s: 1", "duration_s: 1\nduration_s: 2"),
            ("a tab as indentation", "  type: serial_arm", "\ttype: serial_arm"),
            ("an alias without an anchor", "duration_s: 1", "duration_s: *time"),
            ("a tag of Python", "duration_s: 1", "duration_s: !!python/name:os.system"),
            ("a number with very many digits", "duration_s: 1", f"duration_s: {'9' * 5000}"),
            ("a file that is not UTF-8", ALL, "duration_s: 1\nname: café\n".encode("latin-1")),
            ("a control character", "name: arm", "name: a\x07rm"),
        ],
        keyed=False,
    ),
    Edits(
        CHECK,
        {"arm.yaml": ARM},
        [
            ("misspelt key at the top", "integrater: {}\n"),
            ("misspelt key further down", "integrator:\n  rtoll: 1.0e-6\n"),
            ("misspelt variants", "varaints: {}\n"),
            ("key that is like no other", "zzz: 1\n"),
            ("several misspelt keys", "{axis: y}", "{axs: y}", "duration_s: 1", "duration_s: 1\nrecord: {rate: 5}"),
            ("no plant", "plant:\n  type: serial_arm\n  link: {mass_kg: 0.2}\n  chain: [{axis: y}]\n", ""),
            ("no duration", "duration_s: 1\n", ""),
            ("text as duration", "duration_s: 1", "duration_s: soon"),
            ("duration of zero", "duration_s: 1", "duration_s: 0"),
            ("negative duration", "duration_s: 1", "duration_s: -3"),
            ("duration without end", "duration_s: 1", "duration_s: .inf"),
            ("duration that is not a number", "duration_s: 1", "duration_s: .nan"),
            ("duration in quotes", "duration_s: 1", "duration_s: '1'"),
            ("true as duration", "duration_s: 1", "duration_s: true"),
            ("duration with its unit", "duration_s: 1", "duration_s: 1 s"),
            ("number too large to compute with", "duration_s: 1", "duration_s: 1.0e+40"),
            ("number too small to compute with", "{axis: y}", "{axis: y, length_m: 1.0e-40}"),
            ("name with a slash", "name: arm", "name: a/b"),
            ("name of dots", "name: arm", "name: .."),
            ("name that is too long", "name: arm", f"name: {'x' * 300}"),
            ("unknown plant", "type: serial_arm", "type: serial_amr"),
            ("plant without a type", "  type: serial_arm\n", ""),
            ("list as type", "type: serial_arm", "type: [serial_arm]"),
            (
                "text as plant",
                "plant:\n  type: serial_arm\n  link: {mass_kg: 0.2}\n  chain: [{axis: y}]\n",
                "plant: arm\n",
            ),
            ("number as link", "link: {mass_kg: 0.2}", "link: 3"),
            ("mapping as chain", "chain: [{axis: y}]", "chain: {axis: y}"),
            ("empty chain", "chain: [{axis: y}]", "chain: []"),
            (
                "six problems at once",
                "{axis: y}",
                "{axis: q, kind: prismatik, length_m: -1}",
                "duration_s: 1",
                "duration_s: 1\nintegrator: {rtol: x}\nrecord: {rate_hz: -1}\nmetrics: {settle_s: -1}",
            ),
            ("very many unknown keys", "".join(f"nam{k}: 1\n" for k in range(30))),
            ("rate of a record that would need 88 GB", "record: {rate_hz: 5.0e+8}\n"),
            ("relative tolerance of zero", "integrator: {rtol: 0}\n"),
            ("unknown method", "integrator: {method: euler}\n"),
            ("method that was removed", "integrator: {method: rk4}\n"),
            ("step of zero", "integrator: {step_s: 0}\n"),
            ("key of null", "integrator: {rtol: null, method: euler}\n"),
        ],
    ),
    Edits(
        'dynsim.load_scenario("arm.yaml", "heavi")',
        {"arm.yaml": VARIANTS},
        [
            ("misspelt variant", "heavy: {}", "heavy: {name: x}"),
            ("variant of a file without variants", ALL, ARM),
            ("variants in a list", ALL, f"{ARM}variants: [light, heavi]\n"),
            ("variant that is a number", "heavy: {}", "heavi: 3"),
            ("unknown key in a variant", "heavy: {}", "heavi: {plant: {lnk: {}}}"),
        ],
        keyed=False,
    ),
    Calls(
        [
            ("file that does not exist", 'dynsim.load_scenario("elbow_comparision.yaml")'),
            ("folder", 'dynsim.load_scenario(".")'),
            ("None as file", "dynsim.load_scenario(None)"),
            ("number as shipped variant", 'dynsim.load_scenario("elbow_comparison", 3)'),
            ("misspelt variant of a shipped file", 'dynsim.load_scenario("elbow_comparison", "elbow_5")'),
            ("list as overrides", 'dynsim.load_scenario("elbow_comparison", overrides=["a=1"])'),
            ("overrides of numbers", 'dynsim.load_scenario("elbow_comparison", overrides={1: 2})'),
            ("override below a value", 'dynsim.load_scenario("elbow_comparison", overrides={"duration_s.x": 1})'),
            ("override of an unknown key", 'dynsim.load_scenario("elbow_comparison", overrides={"plant.bas": 1})'),
            (
                "scenario of a newer version in a record",
                "data = arm.resolved; data['integrator']['newer'] = 1; scenario.scenario_from_resolved(data)",
            ),
            ("scenario of a record that is not a mapping", "scenario.scenario_from_resolved([1])"),
        ]
    ),
    Settings(
        "elbow_comparison",
        [
            ("setting without a value", "integrator.rtol"),
            ("setting with a colon", "a: b"),
            ("setting without a key", "=1"),
            ("setting with an empty part", "plant..x=1"),
            ("setting of an index that is too large", "plant.chain.7.mass_kg=1"),
            ("setting of a negative index", "plant.chain.-1.mass_kg=1"),
            ("setting of variants", "variants.two_elbows=1"),
            ("setting of the variant", "variant=elbow_7"),
            ("setting of a misspelt key", "duraton_s=1"),
            ("setting of a negative mass", "plant.link.mass_kg=-1"),
            ("setting that is not YAML", "duration_s=[1"),
            ("setting with a path that is too deep", "a" + ".a" * 60 + "=1"),
            ("setting of a text as number", "duration_s=soon"),
            ("setting below a value", "duration_s.x=1"),
        ],
    ),
]
