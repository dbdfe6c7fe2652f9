"""Sweeps, their folders, and comparisons."""

from messages.case import Calls, Commands

AREA = "Sweeps"
ORDER = 130

SWEEP = "sweep single_pendulum --jobs 1 --no-figures"
MASSES = "--grid plant.chain.0.mass_kg=1,2"

TABLES = [
    Commands(
        [
            ("sweep of nothing", SWEEP),
            ("grid without values", f"{SWEEP} --grid plant.chain.0.mass_kg"),
            ("grid of no values", f"{SWEEP} --grid plant.chain.0.mass_kg="),
            ("grid of a value twice", f"{SWEEP} --grid plant.chain.0.mass_kg=1,1"),
            ("grid of a single point", f"{SWEEP} --grid plant.chain.0.mass_kg=0:1:1"),
            ("grid without a count", f"{SWEEP} --grid plant.chain.0.mass_kg=0:1"),
            ("grid with a step instead of a count", f"{SWEEP} --grid plant.chain.0.mass_kg=0:1:0.1"),
            ("grid of too many points", f"{SWEEP} --grid plant.chain.0.mass_kg=0:1:999999999999"),
            ("grid of a misspelt key", f"{SWEEP} --grid plant.chain.0.mas_kg=1,2"),
            ("grid of a value that is not valid", f"{SWEEP} --grid plant.chain.0.mass_kg=-1,2"),
            ("grid twice", f"{SWEEP} {MASSES} {MASSES}"),
            ("grid and setting of a key", f"{SWEEP} {MASSES} --set plant.chain.0.mass_kg=3"),
            ("sample of an unknown law", f"{SWEEP} --sample 'plant.chain.0.mass_kg=cauchy(0,1)'"),
            ("sample without a law", f"{SWEEP} --sample plant.chain.0.mass_kg=1"),
            ("sample without spread", f"{SWEEP} --sample 'plant.chain.0.mass_kg=normal(1,0)'"),
            ("sample with swapped ends", f"{SWEEP} --sample 'plant.chain.0.mass_kg=uniform(2,1)'"),
            ("sample of numbers that are too large", f"{SWEEP} --sample 'plant.chain.0.mass_kg=uniform(-1e308,1e308)'"),
            ("sample of entries that do not exist", f"{SWEEP} --sample 'loads.*.mass_kg=uniform(1,2)'"),
            ("several draws without a sample", f"{SWEEP} {MASSES} --count 3"),
            ("variants of a scenario without variants", f"{SWEEP} {MASSES} --variants all"),
            (
                "variant that does not exist",
                "sweep elbow_comparison --jobs 1 --grid contacts.friction=0,0.1 --variants elbow_5",
            ),
            ("processes and a scheduler", f"{SWEEP} {MASSES} --scheduler tcp://localhost:1"),
            ("plot without figures", f"{SWEEP} {MASSES} --plot steps"),
            ("sweep into a file", f"{SWEEP} {MASSES} --out swept/runs.jsonl"),
            ("sweep into a folder with a sweep", f"{SWEEP} {MASSES} --out swept"),
            ("resumed sweep without a plan", f"{SWEEP} {MASSES} --out swept --resume"),
            ("resumed sweep without its rows", f"{SWEEP} {MASSES} --out rowless --resume"),
            ("resumed sweep with a plan that is cut", f"{SWEEP} {MASSES} --out torn --resume"),
            ("resumed sweep with a plan file of another program", f"{SWEEP} {MASSES} --out other --resume"),
            (
                "sweep of runs that all fail",
                f"{SWEEP} --set duration_s=0.1 --grid plant.chain.0.mass_kg=0,0.0 --out failed",
            ),
            ("comparison without variants", "compare single_pendulum"),
            ("comparison into a file", "compare elbow_comparison --out swept/runs.jsonl"),
        ],
        {
            "swept/runs.jsonl": "",
            "rowless/sweep.csv": "run\n",
            "torn/runs.jsonl": "",
            "torn/sweep.json": "{",
            "other/runs.jsonl": "",
            "other/sweep.json": '{"name": "mine"}',
        },
    ),
    Calls(
        [
            ("row that is cut", """resumed('runs.jsonl', '"run": 1', '')"""),
            ("number of a run that is a text", """resumed('runs.jsonl', '"run": 1', '"run": "1"')"""),
            ("status that is not known", """resumed('runs.jsonl', '"status": "ok"', '"status": "fine"')"""),
            ("numbers that are missing", """resumed('runs.jsonl', '"numbers": ', '"number": ')"""),
            ("plan with other overrides", """resumed('sweep.json', '"duration_s": 0.05', '"duration_s": 0.06')"""),
            ("plan of another version", """resumed('sweep.json', '"dynsim_version": "', '"dynsim_version": "0.')"""),
            ("plan whose overrides are a text", """resumed('sweep.json', '"commit": ', '"commit": 3, "was": ')"""),
        ],
        heading="folders of sweeps",
    ),
]
