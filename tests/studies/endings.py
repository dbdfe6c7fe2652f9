"""Study: thousands of random braced arms; each run must reach its end or a named stop.

Arms of 3 to 12 joints with DC motors lean on planes, pipes, spheres, boxes and terrain. Declared points, all joints or
all links may touch, with static friction equal to kinetic friction or larger, payloads, pushes, soft and stiff gains,
and hand paths.

    PYTHONPATH=tests python -m studies.endings --count 10000 --jobs 2

writes results/endings/endings.json, which docs/validation/evidence.md quotes, in about half an hour; ``--journal FILE``
stores completed scenes and resumes from them.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from dynsim._version import __version__
from dynsim.engine import Progress, simulate
from dynsim.errors import DynsimError, SimulationInterrupted, SimulationStopped
from dynsim.scenario.reading import scenario_from_resolved
from dynsim.studies.processes import WorkerInterrupted, WorkerLost, run_in_processes
from dynsim.system.files import write_json

Array = NDArray[np.float64]

FILE = Path("results/endings/endings.json")
SEED = 27
# Wall time after which a run counts as cut off [s]: a hundred times the longest run.
WALL_LIMIT_S = 60.0
METHODS = ("radau5", "radau5", "dopri5", "time_stepping")
SURFACES = ("plane", "cylinder", "sphere", "box", "height_field")
FINISHED, REFUSED = "finished", "refused"
TERRAINS = 4
# Number of grid points of a terrain along each side, and their spacing [m].
GRID, SPACING = 24, 0.15


@dataclass(frozen=True)
class Ending:
    """Ending of one scene.

    Attributes
    ----------
    scene : int
        Number of the scene.
    status : str
        ``finished``, ``refused`` before the first step, or the kind of the stop.
    reason : str
        Reason of a stop or refusal.
    time_s : float
        Simulated time [s].
    wall_s : float
        Wall time of the integration [s].
    """

    scene: int
    method: str
    surface: str
    status: str
    reason: str
    time_s: float
    wall_s: float


def scene(number: int, terrains: Sequence[str]) -> dict[str, Any]:
    """Return a scene by its number, as in a scenario file; ``terrains``: files of :func:`write_terrains`."""
    random = np.random.default_rng([SEED, number])
    method, surface = str(random.choice(METHODS)), str(random.choice(SURFACES))
    duration = float(random.uniform(0.3, 1.0))
    chain, elbow = _chain(random)
    joints = _places(chain)
    radius = float(random.uniform(0.01, 0.04))
    candidates = str(random.choice(("points", "joints", "links"), p=(0.5, 0.3, 0.2)))
    # On the surface, or above it by the distance of a fall of 0.1 s.
    braced = bool(random.random() < 0.6)
    thick = 1.02 * radius if candidates == "links" else 0.0
    below = joints[elbow] - [0.0, 0.0, thick + (0.0 if braced else float(random.uniform(0.0, 0.05)))]
    points: dict[str, Any] = {"elbow": {"body": f"link_{elbow + 1}", "surface": surface}}
    if candidates == "links":
        points = {}
    elif random.random() < 0.3:
        points["hand"] = {
            "body": f"link_{len(chain)}",
            "point_m": [0.0, 0.0, chain[-1]["length_m"]],
            "surface": surface,
        }
    kinetic = float(random.choice((0.0, 0.1, random.uniform(0.05, 1.0)), p=(0.1, 0.1, 0.8)))
    contacts: dict[str, Any] = {"law": "unilateral", "friction": kinetic, "candidates": candidates, "points": points}
    if random.random() < 0.5:
        contacts["static_friction"] = kinetic * float(random.uniform(1.0, 2.0))
        if random.random() < 0.2:
            contacts["stribeck_m_s"] = float(random.choice((0.01, 0.1)))
    if random.random() < 0.15:
        contacts["restitution"] = float(random.uniform(0.1, 0.8))
    settings: dict[str, Any] = {
        "name": f"scene_{number}",
        "duration_s": duration,
        "plant": {"type": "serial_arm", "link": _link(random, radius), "chain": chain},
        "controller": _controller(random, chain, joints, duration),
        "surfaces": {surface: _surface(random, surface, below, terrains)},
        "contacts": contacts,
        "integrator": {"method": method, "wall_limit_s": WALL_LIMIT_S},
        "record": {"rate_hz": 50.0},
        "metrics": {"settle_s": 0.0},
    }
    if braced and "elbow" in points:
        settings["initial"] = {"on_surface": ["elbow"]}
    if loads := _loads(random, chain, duration):
        settings["loads"] = loads
    return settings


def _chain(random: Generator) -> tuple[list[dict[str, Any]], int]:
    """Return an arm that descends to its elbow and rises behind it, and the number of the elbow's joint."""
    n = int(random.integers(3, 13))
    yaw = bool(n > 3 and random.random() < 0.6)
    elbow = int(random.integers(2 if yaw else 1, n))
    chain: list[dict[str, Any]] = []
    before = 0.0
    for k in range(n):
        # Rotation of a link about its own axis turns only the following links.
        axis, angle, length = "z", float(random.uniform(-20, 20)), float(random.uniform(0.15, 0.4))
        if k == 0 and yaw:
            length = 0.0
        elif k in (int(yaw), elbow) or random.random() < 0.8:
            # Angle of the link to the vertical: down before the elbow, up behind it.
            pitch = float(random.uniform(95, 130) if k < elbow else random.uniform(30, 85))
            axis, angle, before = "y", pitch - before, pitch
        mass = float(random.uniform(0.1, 1.0))
        chain.append({"axis": axis, "length_m": length, "mass_kg": mass, "initial_deg": angle})
    return chain, elbow


def _places(chain: Sequence[Mapping[str, Any]]) -> Array:
    """Return the positions of joints and hand at the start, (n + 1, 3) [m]."""
    rotation, position, positions = np.eye(3), np.zeros(3), []
    for link in chain:
        positions.append(position)
        angle = math.radians(link["initial_deg"])
        c, s = math.cos(angle), math.sin(angle)
        turn = [[c, 0, s], [0, 1, 0], [-s, 0, c]] if link["axis"] == "y" else [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        rotation = rotation @ np.array(turn)
        position = position + link["length_m"] * rotation[:, 2]
    return np.array([*positions, position])


def _link(random: Generator, radius: float) -> dict[str, Any]:
    """Return the keys of all links: a published motor, or one of the size of Maxon's RE 40 with a gear of 113:1."""
    motor: dict[str, Any] = {"type": "wang_minami"}
    if random.random() < 0.5:
        motor = {
            "type": "dc",
            "torque_constant_N_m_per_A": 0.0302,
            "resistance_ohm": 0.299,
            "inductance_H": 8.23e-5,
            "rotor_inertia_kg_m2": 1.42e-5,
            "gear_ratio": 113,
            "gear_damping_N_m_s_per_rad": 3e-6,
            "mass_kg": 0.48,
        }
    if random.random() < 0.4:
        motor["voltage_limit_V"] = 24
    return {"radius_m": radius, "damping_N_m_s_per_rad": float(random.uniform(0.02, 0.5)), "motor": motor}


def _controller(
    random: Generator, chain: Sequence[Mapping[str, Any]], joints: Array, duration: float
) -> dict[str, Any]:
    """Return gains from soft to stiff for an arm that holds its posture, or moves some joints, or its hand."""
    gain = float(10.0 ** random.uniform(1.0, 3.3))
    settings: dict[str, Any] = {"type": "joint_pd", "k_p_V_per_rad": gain, "k_d_V_s_per_rad": gain * 0.04}
    moves = random.random()
    if moves < 0.35:
        for k in random.choice(len(chain), size=min(3, len(chain)), replace=False).tolist():
            start = chain[k]["initial_deg"]
            angles = [start, start + float(random.uniform(-40, 40)), start + float(random.uniform(-40, 40))]
            times = [0.0, 0.5 * duration, duration]
            settings.setdefault("joints", {})[f"joint_{k + 1}"] = {"times_s": times, "angles_deg": angles}
    elif moves < 0.55:
        there = joints[-1] + random.uniform(-0.05, 0.05, size=3)
        if all(link["axis"] == "y" for link in chain):
            there[1] = 0.0
        path = {"type": "line", "from_m": joints[-1].tolist(), "to_m": there.tolist(), "duration_s": duration}
        settings["hand"] = {"joints": [f"joint_{k + 1}" for k in range(len(chain))], "path": path}
    return settings


def _surface(random: Generator, kind: str, below: Array, terrains: Sequence[str]) -> dict[str, Any]:
    """Return a surface whose top is at a position, (3,) [m]."""
    size = float(random.uniform(0.05, 0.3))
    x, y, z = below.tolist()
    if kind == "plane":
        return {"type": kind, "point_m": [x, y, z], "normal": [float(random.uniform(-0.1, 0.1)), 0.0, 1.0]}
    if kind == "cylinder":
        angle = float(random.uniform(-0.5, 0.5))
        axis = [math.sin(angle), math.cos(angle), 0.0]
        return {"type": kind, "point_m": [x, y, z - size], "axis": axis, "radius_m": size}
    if kind == "sphere":
        return {"type": kind, "center_m": [x, y, z - size], "radius_m": size}
    if kind == "box":
        edges = random.uniform(0.1, 0.5, size=3).tolist()
        turn = [0.0, 0.0, float(random.uniform(-90, 90))]
        return {"type": kind, "center_m": [x, y, z - 0.5 * edges[2]], "edges_m": edges, "rpy_deg": turn}
    # The terrain is highest in its middle, below the arm.
    corner = -0.5 * SPACING * (GRID - 1)
    file = str(random.choice(list(terrains)))
    return {"type": kind, "file": file, "spacing_m": [SPACING] * 2, "origin_m": [x + corner, y + corner, z]}


def _loads(random: Generator, chain: Sequence[Mapping[str, Any]], duration: float) -> dict[str, Any]:
    """Return a payload, a steady force or a push."""
    last, loads = f"link_{len(chain)}", dict[str, Any]()
    if random.random() < 0.3:
        tip = [0.0, 0.0, chain[-1]["length_m"]]
        mass, size = float(random.uniform(0.1, 1.0)), 0.03
        loads["tool"] = {"type": "payload", "body": last, "point_m": tip, "mass_kg": mass, "radius_m": size}
    if random.random() < 0.15:
        loads["wind"] = {"type": "constant", "body": last, "force_N": random.uniform(-3, 3, size=3).tolist()}
    if random.random() < 0.15:
        times = (np.array([0.2, 0.4, 0.6]) * duration).tolist()
        force = [[0.0] * 3, random.uniform(-20, 20, size=3).tolist(), [0.0] * 3]
        loads["push"] = {"type": "samples", "body": last, "times_s": times, "force_N": force}
    return loads


def write_terrains(folder: Path) -> list[str]:
    """Write height fields of hills, highest in the middle, where they are zero; return their files."""
    files = []
    for k in range(TERRAINS):
        random = np.random.default_rng([SEED, 1_000_000 + k])
        x = SPACING * (np.arange(GRID) - 0.5 * (GRID - 1))
        heights = np.zeros((GRID, GRID))
        for _ in range(6):
            size, wave, phase = random.uniform(0.01, 0.04), random.uniform(1.0, 4.0, size=2), random.uniform(0, 6.28, 2)
            heights += size * np.outer(np.cos(wave[0] * x + phase[0]), np.cos(wave[1] * x + phase[1]))
        middle = heights[GRID // 2 - 1 : GRID // 2 + 1, GRID // 2 - 1 : GRID // 2 + 1].max()
        heights -= middle + 0.2 * np.hypot(*np.meshgrid(x, x))
        path = folder / f"terrain_{k}.npy"
        np.save(path, heights)
        files.append(str(path))
    return files


def end(number: int, terrains: Sequence[str], look: Progress | None = None) -> Ending:
    """Simulate a scene and return its ending.

    Raises
    ------
    SimulationInterrupted
        If ``look`` raises KeyboardInterrupt, or on Ctrl-C.
    """
    drawn, record = scene(number, terrains), None
    status, reason, time = FINISHED, "", drawn["duration_s"]
    try:
        record = simulate(scenario_from_resolved(drawn), look, pictured=False)
    except SimulationInterrupted:
        raise
    except SimulationStopped as stop:
        status, reason, time, record = stop.kind, str(stop), stop.time, stop.record
    except DynsimError as error:
        status, reason, time = REFUSED, str(error), 0.0
    method, surface = drawn["integrator"]["method"], next(iter(drawn["surfaces"]))
    wall = 0.0 if record is None else float(record.summary["integration_wall_s"])
    return Ending(number, method, surface, status, reason, time, wall)


def endings(
    numbers: Iterable[int], jobs: int, terrains: Sequence[str], take: Callable[[Ending], None]
) -> tuple[list[Ending], bool]:
    """Return the endings in the order of the scenes, and whether Ctrl-C came before all ended; ``take`` gets each."""
    ended: list[Ending] = []

    def take_late(number: int, result: Callable[[], Ending | None]) -> None:
        try:
            ending = result()
        except WorkerInterrupted:
            return
        except WorkerLost as lost:
            ending = Ending(number, "", "", type(lost).__name__, "its process was lost", 0.0, 0.0)
        except SimulationInterrupted:
            return
        if ending is not None:
            ended.append(ending)
            take(ending)

    interrupted = run_in_processes(_Work(terrains), numbers, jobs, take_late)
    return sorted(ended, key=lambda ending: ending.scene), interrupted


class _Work:
    """:func:`end` as a task for processes."""

    def __init__(self, terrains: Sequence[str]) -> None:
        self._terrains = list(terrains)

    def __call__(self, number: int, look: Progress) -> Ending:
        return end(number, self._terrains, look)


def account(ended: Sequence[Ending]) -> dict[str, Any]:
    """Return numbers of endings by method and surface, wall times, and the first scene of each kind of ending."""
    kinds = sorted({ending.status for ending in ended})
    walls = {
        method: [ending.wall_s for ending in ended if ending.method == method and ending.status != REFUSED]
        for method in sorted(set(METHODS))
    }
    longest = max(ended, key=lambda ending: ending.wall_s)
    return {
        "scenes": len(ended),
        "by_status": dict(Counter(ending.status for ending in ended).most_common()),
        "by_method": {name: _counted(ending.status for ending in ended if ending.method == name) for name in walls},
        "by_surface": {
            name: _counted(ending.status for ending in ended if ending.surface == name) for name in SURFACES
        },
        "wall_s": {name: {"median": float(np.median(w)), "longest": max(w)} for name, w in walls.items() if w},
        "longest": {"scene": longest.scene, "wall_s": longest.wall_s, "status": longest.status},
        "examples": {
            kind: {"scene": first.scene, "method": first.method, "reason": _short(first.reason)}
            for kind in kinds
            if kind != FINISHED
            for first in [next(candidate for candidate in ended if candidate.status == kind)]
        },
        "refused_because": _counted(_why(ending.reason) for ending in ended if ending.status == REFUSED),
    }


def _counted(values: Iterable[str]) -> dict[str, int]:
    return dict(Counter(values).most_common())


def _short(reason: str) -> str:
    return " ".join(reason.split())


def _why(reason: str) -> str:
    """Return a refusal without its names and numbers."""
    words = ["…" if any(c.isdigit() or c in "'_" for c in word) else word for word in reason.split()[1:]]
    return " ".join(word for k, word in enumerate(words) if word != "…" or words[k - 1] != "…")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m studies.endings", description=__doc__)
    parser.add_argument("--count", type=int, default=10_000, help="scenes")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--out", type=Path, default=FILE, help="file for the result")
    parser.add_argument("--journal", type=Path, help="file with a line for each scene; scenes in it are not run again")
    return parser.parse_args()


def note(journal: Path, ending: Ending) -> None:
    """Add a line to a journal."""
    with journal.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(asdict(ending)) + "\n")


def noted(journal: Path | None) -> list[Ending]:
    """Return the entries of a journal; a killed process may have left an unfinished line."""
    ended: list[Ending] = []
    if journal is not None and journal.exists():
        for line in journal.read_text("utf-8").splitlines():
            with suppress(ValueError, TypeError):
                ended.append(Ending(**json.loads(line)))
    return ended


def main() -> None:
    """Run the scenes, print their endings, and save them."""
    options = _options()
    wanted = range(options.first, options.first + options.count)
    earlier = [ended_scene for ended_scene in noted(options.journal) if ended_scene.scene in wanted]
    left = sorted(set(wanted) - {ended_scene.scene for ended_scene in earlier})
    keep: Callable[[Ending], None] = (
        partial(note, options.journal) if options.journal is not None else lambda ending: None
    )
    with tempfile.TemporaryDirectory() as temporary:
        ended, stopped = endings(left, options.jobs, write_terrains(Path(temporary)), keep)
    result = account(sorted([*earlier, *ended], key=lambda entry: entry.scene))
    print(json.dumps(result, indent=2, ensure_ascii=False))
    if not stopped:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        write_json(options.out, {"dynsim_version": __version__, "seed": SEED, **result})


if __name__ == "__main__":
    # Import the module under its full name, by which other processes find it.
    from studies import endings as module

    module.main()
