"""Damaged fault scripts of the virtual servos, in a short replay."""

from __future__ import annotations

import shutil
from contextlib import nullcontext
from pathlib import Path
from random import Random

from fuzz.case import Draft
from fuzz.mutations import mutate_text, mutate_tree, yaml_text
from fuzz.readings import missing, yaml_tree

SCRIPT = """\
seed: 3
faults:
  - {kind: lost_status, id: 2, at: 1.0, probability: 0.2}
  - {kind: late_status, id: 1, at: 0.1, delay: 0.02, duration: 0.01}
  - {kind: stuck, id: 2, at: 2.5}
  - {kind: noise, at: 0.5}
  - {kind: offset_jump, id: 1, at: 1.5, angle: 0.5}
  - {kind: voltage_sag, at: 0.2, drop: 7.0, duration: 0.1}
  - {kind: wrong_firmware, id: 7, value: 38}
  - {kind: supply_loss, at: 4.0}
  - {kind: temperature_ramp, id: 1, heating_rate: 200.0}
"""


def make_motion(folder: Path) -> None:
    """Make a short record of the small robot of ``studies.fault_table``, its map, and the measured record of a replay.

    ``measured.part`` is the file that a replay leaves if its process dies.
    """
    from studies.fault_table import MAP, Rig, swing

    from dynsim.hardware.replay import session
    from dynsim.hardware.replay.output import PART
    from dynsim.hardware.servo_map import load_servo_map

    swing(0.1).save(folder / "rig.h5")
    (folder / "rig.yaml").write_text(MAP.replace("run_up: 20", "run_up: 20, approach_velocity: 1.0"), encoding="utf-8")
    rig = Rig(load_servo_map(folder / "rig.yaml"), swing(0.1))
    run, save = rig.prepare(), session._save
    session._save = lambda *_: None  # type: ignore[assignment]
    try:
        connection = nullcontext((run.replay.bus, run.clock))
        result = session.run_replay(rig.motion(), rig.map, connection, folder / "replay", live=True)
    finally:
        session._save = save
    result.record.provenance = {
        key: item for key, item in result.record.provenance.items() if "time" not in key and "date" not in key
    }
    result.record.save(folder / "measured.h5")
    (folder / "replay" / PART).rename(folder / PART)
    shutil.rmtree(folder / "replay")


def draw(rng: Random, records: Path) -> Draft:
    tree = yaml_tree(SCRIPT)
    tree["faults"] = rng.sample(tree["faults"], rng.choice((1, 2, 4)))
    if rng.random() < 0.7:
        mutation = "; ".join(mutate_tree(rng, tree) for _ in range(rng.choice((1, 1, 2))))
        data = yaml_text(tree).encode("utf-8", "surrogatepass")
    else:
        data, mutation = mutate_text(rng, yaml_text(tree))
    files = {"faults.yaml": data, "rig.h5": (records / "rig.h5").read_bytes()}
    files["rig.yaml"] = (records / "rig.yaml").read_bytes()
    command = ["hw", "replay", "rig.h5", "--map", "rig.yaml", "--port", "virtual", "--faults", "faults.yaml", "--quiet"]
    return Draft(mutation, files, [[*command, "--out", "out"]], losses)


def losses() -> list[str]:
    """Return faults of the script that dynsim did not load."""
    from dynsim.hardware.virtual.faults import load_fault_script

    script = load_fault_script("faults.yaml")
    return missing(yaml_tree(Path("faults.yaml").read_text(encoding="utf-8")), script.model_dump())
