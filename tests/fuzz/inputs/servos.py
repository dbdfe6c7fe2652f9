"""Replays on virtual servos with valid maps and fault scripts; damaged measured records and streams of dead replays."""

from __future__ import annotations

import copy
from pathlib import Path
from random import Random

from fuzz.case import Draft
from fuzz.inputs.faults import SCRIPT
from fuzz.inputs.faults import losses as fault_losses
from fuzz.inputs.options import NUMBER_TEXTS
from fuzz.inputs.servo_map import losses as map_losses
from fuzz.mutations import mutate_blocks, mutate_bytes, vary, yaml_text
from fuzz.readings import Unreadable, yaml_tree

GATES = ("{}", "{rms_rad: 1}", "{rms_rad: 1e-9}", "{max_rad: 0.5, delay_s: 0.2}", "{rms_rad: -1}", "{x: 1}", "[]", "")
# Faults with which a replay may still succeed, and all others.
FAULTS = (*yaml_tree(SCRIPT)["faults"], {"kind": "echo"}, {"kind": "backlash", "id": 1, "angle": 0.01})


def draw(rng: Random, records: Path, kind: str) -> Draft:
    read = {name: (records / name).read_bytes() for name in ("rig.h5", "rig.yaml", "measured.h5", "measured.part")}
    if kind == "servo_options":
        return _replay(rng, read)
    files: dict[str, bytes | str] = {"rig.h5": read["rig.h5"]}
    name = "measured.h5" if kind == "measured" else "measured.part"
    data, mutation = read[name], "sound"
    if rng.random() < 0.75:
        data, mutation = rng.choice((mutate_bytes, mutate_blocks))(rng, data)
    if kind == "recovery":
        files["out/measured.part"] = data
        if rng.random() < 0.3:
            files["out/summary.json"] = rng.choice((b"{}", b"[", b'{"end_state": 1}', b'{"end_state": "limp"}'))
        command = ["hw", "recover", "out", *(["--out", "other"] if rng.random() < 0.2 else [])]
        return Draft(f"{mutation}: {' '.join(command)}", files, [command], recovery_losses)
    files["measured.h5"] = data
    command = ["hw", "compare", "rig.h5", "measured.h5", "--out", "compared"]
    if rng.random() < 0.4:
        files["gate.yaml"] = rng.choice(GATES).encode()
        command += ["--gate", "gate.yaml"]
    if rng.random() < 0.3:
        command += ["--joint", rng.choice(("shoulder", "elbow", "x", "", "[red]"))]
    if rng.random() < 0.4:
        command += ["--trust"]
    return Draft(f"{mutation}: {' '.join(command)}", files, [command])


def _replay(rng: Random, read: dict[str, bytes]) -> Draft:
    tree = yaml_tree(read["rig.yaml"].decode())
    keys = [vary(rng, tree, ("id", "baud", "rate", "policy")) for _ in range(rng.choice((0, 1, 2)))]
    script = {"seed": rng.randrange(9), "faults": copy.deepcopy(rng.sample(FAULTS, rng.choice((0, 0, 1, 2))))}
    keys += [vary(rng, script, ("id", "seed"))] if script["faults"] else []
    files: dict[str, bytes | str] = {
        "rig.h5": read["rig.h5"], "map.yaml": yaml_text(tree).encode(), "faults.yaml": yaml_text(script).encode(),
    }  # fmt: skip
    command = ["hw", "check", "rig.h5", "--map", "map.yaml"]
    if rng.random() < 0.7:
        command[1] = "replay"
        command += ["--port", "virtual", "--faults", "faults.yaml", "--quiet", "--out", "out"]
        command += ["--policy", rng.choice(("hold", "decelerate", "off", "x"))] if rng.random() < 0.3 else []
    for option, sound in (("--speed", ("0.5", "1", "0.8")), ("--rate", ("50", "100", "200"))):
        if rng.random() < 0.3:
            command += [option, rng.choice(sound) if rng.random() < 0.8 else rng.choice(NUMBER_TEXTS)]
    return Draft(f"{', '.join(keys)}: {' '.join(command)}", files, [command], replay_losses)


def replay_losses() -> list[str]:
    """Return losses of the map and the script, and a measured record that cannot be read."""
    from dynsim.record import Record

    lost = map_losses() + fault_losses()
    if Path("out/measured.h5").exists():
        Record.load("out/measured.h5")
    return lost


def recovery_losses() -> list[str]:
    """Return a recovered record that cannot be read or claims to be complete."""
    from dynsim.record import Record

    folder = next((name for name in ("other", "out") if Path(name, "measured.h5").is_file()), None)
    if folder is None:
        raise Unreadable("nothing was recovered")
    record = Record.load(f"{folder}/measured.h5")
    return ["a recovered record claims to be complete"] if record.complete else []
