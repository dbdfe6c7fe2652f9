"""``dynsim sweep`` as a user meets it: where its files go, what it says, how it ends."""

import subprocess
import sys
from pathlib import Path

from dynsim.scenario import find_scenario

SHORT = ["--set", "duration_s=0.2", "--set", "metrics.settle_s=0.05"]
LENGTH = "plant.chain.0.length_m"


def sweep(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dynsim", "sweep", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)


def test_a_sweep_is_named_by_its_scenario(tmp_path: Path):
    content, file = find_scenario("single_pendulum").read_text("utf-8"), tmp_path / "scenario.yaml"
    file.write_text(content.replace("name: single_pendulum", "name: swinging"), encoding="utf-8")
    result = sweep(str(file), "--grid", f"{LENGTH}=0.5,1", *SHORT, "--no-figures", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    folder = tmp_path / "results" / "swinging" / "sweep"
    assert (folder / "sweep.csv").is_file()
    assert not (tmp_path / "results" / "scenario").exists()
