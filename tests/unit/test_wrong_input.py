"""Wrong arguments to the Python interface: each raises one error of dynsim with the fix."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.messages import check_message, raises

import dynsim
from dynsim.compile.model import Model
from dynsim.draw import figures
from dynsim.draw.figures import snake as snake_figures
from dynsim.draw.figures import style
from dynsim.engine import recording
from dynsim.errors import CheckRefused, DynsimError, MissingEntry, ModelError, RecordError, ScenarioError
from dynsim.hardware.errors import ServoMapError
from dynsim.hardware.replay.check import check_motion
from dynsim.hardware.replay.compare import compare_records
from dynsim.hardware.servo_map import load_servo_map
from dynsim.model.description import Inertia, Link, Robot
from dynsim.record import Record
from dynsim.record.joint_motion import export_record
from dynsim.scenario import build, build_model, load_scenario, scenario_from_resolved, variant_names

Q = np.zeros(10)
ORIGIN = [0.0, 0.0, 0.0]


@pytest.fixture(scope="module")
def model() -> Model:
    return build_model(load_scenario("elbow_comparison"))


@pytest.mark.parametrize(
    ("call", "names"),
    [
        (lambda m: m.point_position(10, ORIGIN, Q), ("10", "0", "9")),
        (lambda m: m.point_jacobian(-1, ORIGIN, Q), ("-1", "0", "9")),
        (lambda m: m.point_position(np.int64(10), ORIGIN, Q), ("10", "0", "9")),
        (lambda m: m.body_pose(True, Q), ("True", "link_1, link_2")),
        (lambda m: m.body_pose(None, Q), ("None", "link_1, link_2")),
        (lambda m: m.body_pose("link_11", Q), ("link_11", "link_1, link_2")),
        (lambda m: m.mass_matrix("upright"), ("q", "'upright'")),
        (lambda m: m.mass_matrix(["0"] * 10), ("q", "['0', '0'")),
        (lambda m: m.mass_matrix(None), ("q", "None")),
        (lambda m: m.mass_matrix(Q + 1j), ("q", "array([0.+1.j")),
        (lambda m: m.mass_matrix([[0.0], [0.0, 1.0]]), ("q",)),
        (lambda m: m.mass_matrix(Q[:9]), ("q", "(9,)", "10")),
        (lambda m: m.mass_matrix(np.where(np.arange(10) == 2, np.nan, 0.0)), ("q", "nan", "joint_3")),
        (lambda m: m.bias_forces(Q, Q - np.inf), ("v", "-inf", "joint_1")),
        (lambda m: m.inverse_dynamics(Q, Q, Q * np.nan), ("vdot", "nan", "joint_1")),
        (lambda m: m.forward_dynamics(Q, Q, [1.0]), ("tau", "(1,)", "10")),
        (lambda m: m.point_position(0, "tip", Q), ("point", "'tip'")),
        (lambda m: m.point_position(0, [0.0, np.nan, 0.0], Q), ("point", "[0.0, nan, 0.0]")),
        (lambda m: Model("elbow_comparison"), ("Robot", "'elbow_comparison'", "Model.from_urdf")),
        (lambda m: Model.from_urdf(None), ("URDF", "None")),
    ],
)
def test_a_model_names_what_it_cannot_take(model: Model, call: Any, names: tuple[str, ...]) -> None:
    with raises(ModelError, *names) as caught:
        call(model)
    assert "\n" not in str(caught.value)


def test_indices_of_numpy_are_taken(model: Model) -> None:
    by_name = model.point_position("link_4", ORIGIN, Q + 0.3)
    assert model.point_position(np.int64(3), ORIGIN, Q + 0.3).tolist() == by_name.tolist()


BODY = Link("body", "hinge", None, "revolute", np.array([0.0, 0.0, 1.0]), Inertia(1.0))


@pytest.mark.parametrize(
    ("link", "robot", "names"),
    [
        ({"axis": np.array([0.0, 1.0])}, {}, ("hinge", "axis", "array([0., 1.])", "(3,)")),
        ({"axis": "z"}, {}, ("hinge", "axis", "'z'")),
        ({"R_PJ": np.eye(2)}, {}, ("hinge", "R_PJ", "array([[1., 0.], [0., 1.]])", "(3, 3)")),
        ({"p_PJ": np.full(3, np.nan)}, {}, ("hinge", "p_PJ", "array([nan, nan, nan])", "(3,)")),
        ({"p_PJ": [[0.0], [0.0, 1.0]]}, {}, ("hinge", "p_PJ", "[[0.0], [0.0, 1.0]]", "(3,)")),
        ({"inertia": Inertia(1.0, np.full(3, np.inf))}, {}, ("body", "array([inf, inf, inf])", "(3,)")),
        ({"inertia": Inertia(1.0, tensor=np.zeros(6))}, {}, ("body", "array([0., 0., 0., 0., 0., 0.])", "(3, 3)")),
        ({"inertia": Inertia("1")}, {}, ("body", "'1'")),
        ({}, {"hand": ("tip", np.zeros(3))}, ("arm", "'tip'", "body")),
        ({}, {"hand": ("body", np.zeros(2))}, ("arm", "hand", "array([0., 0.])", "(3,)")),
        ({}, {"gravity": 9.81}, ("arm", "gravity", "9.81", "(3,)")),
        ({}, {"q0": np.zeros(2)}, ("arm", "q0", "array([0., 0.])", "(1,)")),
    ],
)
def test_a_description_by_hand_is_refused_with_the_quantity(link: Any, robot: Any, names: tuple[str, ...]) -> None:
    with raises(ModelError, *names):
        Model(replace(Robot("arm", (replace(BODY, **link),), (), ("body", np.zeros(3))), **robot))


@pytest.mark.parametrize(
    ("call", "error", "names"),
    [
        (lambda: load_scenario(None), ScenarioError, ("scenario", "None")),
        (lambda: variant_names(3), ScenarioError, ("scenario", "3")),
        (lambda: load_scenario("elbow_comparison", 3), ScenarioError, ("3", "two_elbows, elbow_7")),
        (lambda: load_scenario("elbow_comparison", ["a"]), ScenarioError, ("['a']", "two_elbows, elbow_7")),
        (lambda: load_scenario("elbow_comparison", overrides=["a=1"]), ScenarioError, ("overrides", "['a=1']")),
        (lambda: load_scenario("elbow_comparison", overrides={1: 2}), ScenarioError, ("overrides", "{1: 2}")),
        (lambda: scenario_from_resolved(None), ScenarioError, ("scenario", "None")),
        (lambda: build_model("elbow_comparison"), ScenarioError, ("Scenario", "'elbow_comparison'", "load_scenario")),
        (lambda: dynsim.check("elbow_comparison"), ScenarioError, ("Scenario", "'elbow_comparison'", "load_scenario")),
        (lambda: dynsim.compare("elbow_comparison", jobs=0), ScenarioError, ("jobs = 0",)),
        (lambda: dynsim.compare("elbow_comparison", jobs="2"), ScenarioError, ("jobs = '2'",)),
        (lambda: build_model(load_scenario("snake_operator")), ModelError, ("snake", "kinematic")),
        (
            lambda: build.controller(s := load_scenario("single_pendulum"), build_model(s)),
            ModelError,
            ("controller",),
        ),
        (lambda: load_servo_map(None), ServoMapError, ("None",)),
    ],
)
def test_scenarios_and_maps_name_what_they_cannot_take(
    call: Any, error: type[DynsimError], names: tuple[str, ...]
) -> None:
    with raises(error, *names) as caught:
        call()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("center", [(1.4, 1.45, 0.4), np.array([1.4, 1.45, 0.4]), np.array([1.4, 1.45, 0.4])[::1]])
def test_overrides_may_be_arrays_and_tuples(center: Any) -> None:
    scenario = load_scenario("elbow_comparison", overrides={"controller.hand.path.center_m": center})
    assert scenario.controller.hand.path.center_m == [1.4, 1.45, 0.4]
    assert load_scenario("elbow_comparison", overrides={"duration_s": np.float64(3)}).duration_s == 3.0


def small_record() -> Record:
    record = Record(np.linspace(0.0, 1.0, 5), provenance={"engine": "dynamics"})
    record.add("q", np.zeros((5, 2)), "rad", labels=("a", "b"))
    record.summary = {"steps": 3}
    return record


@pytest.mark.parametrize(
    ("call", "names"),
    [
        (lambda r: r["v"], ("'v'", "q")),
        (lambda r: r[0], ("0", "q")),
        (lambda r: r[["q"]], ("['q']", "q")),
        (lambda r: r.units["v"], ("'v'", "q")),
        (lambda r: r.labels["v"], ("'v'", "q")),
        (lambda r: r.summary["step"], ("summary", "'step'", "steps")),
        (lambda r: r.provenance["scenario"], ("provenance", "'scenario'", "engine")),
    ],
)
def test_what_a_record_lacks_is_a_sentence(call: Any, names: tuple[str, ...]) -> None:
    for record in (small_record(), copy.deepcopy(small_record()), pickle.loads(pickle.dumps(small_record()))):
        with raises(MissingEntry, *names) as caught:
            call(record)
        # For those who look for KeyError, and for the command line.
        assert isinstance(caught.value, KeyError)
        assert isinstance(caught.value, RecordError)


def test_summary_and_provenance_are_mappings_still(tmp_path: Path) -> None:
    record = Record.load(small_record().save(tmp_path / "record.h5"))
    assert (record.summary, record.provenance) == ({"steps": 3}, {"engine": "dynamics"})
    assert record.summary.get("none") is None
    record.summary |= {"more": 1}
    assert record.summary == {"steps": 3, "more": 1}
    with raises(RecordError, "summary", "3"):
        record.summary = 3  # type: ignore[assignment]


def lacking(record: Record, name: str) -> Record:
    result = copy.copy(record)
    result.signals = {other: signal for other, signal in record.signals.items() if other != name}
    return result


class Asked(dict[str, Any]):
    """Signals that note which of them were asked for."""

    def __init__(self, signals: dict[str, Any], names: set[str]) -> None:
        super().__init__(signals)
        self.names = names

    def __getitem__(self, name: str) -> Any:
        self.names.add(name)
        return super().__getitem__(name)

    def __contains__(self, name: object) -> bool:
        self.names.add(str(name))
        return super().__contains__(name)


@pytest.mark.long  # draws dozens of figures
@pytest.mark.parametrize("scenario", ["elbow_comparison", "snake_joint_limits"])
def test_a_record_that_lacks_a_signal_is_drawn_without_or_refused(scenario: str, tmp_path: Path, monkeypatch) -> None:
    # What is drawn counts here, not the pictures; and a figure that does not ask for a signal is drawn without it.
    asks: dict[Any, set[str]] = {}
    animate = snake_figures.animate

    def drawn(make: Any, record: Record, *arguments: Any) -> Any:
        if make not in asks:
            asked = copy.copy(record)
            asked.signals = Asked(record.signals, asks.setdefault(make, set()))
            return make(asked, *arguments)
        return make(record, *arguments) if asks[make] & (full.keys() - record.keys()) else make

    def save_all(makers: Any, record: Record, *_: Any) -> list[Any]:
        with style.look():
            return [figure for make in makers.values() if (figure := drawn(make, record)) is not None]

    short = {"duration_s": 0.2, "record.rate_hz": 50, "metrics.settle_s": 0.0}
    full = dynsim.simulate(load_scenario(scenario, overrides=short))
    monkeypatch.setattr(snake_figures, "FRAMES", 2)
    with monkeypatch.context() as patch:
        patch.setattr(style, "save_all", save_all)
        patch.setattr(snake_figures, "animate", lambda *arguments: drawn(animate, *arguments))
        assert figures.draw(full, tmp_path)
        outcomes = set()
        for name in full:
            try:
                outcomes.add(bool(figures.draw(lacking(full, name), tmp_path)))
            except RecordError as error:
                outcomes.add(repr(name) in str(error) and "refused")
        assert outcomes == {True, "refused"}
    monkeypatch.setattr(style, "save", lambda figure, path: path)
    # Who made it does not count.
    for odd in ({}, {"engine": ["?"], "robot": "x"}):
        other = copy.copy(full)
        other.provenance = odd
        assert figures.draw(other, tmp_path)
        assert figures.draw_comparison({"a": other}, tmp_path)


@pytest.mark.long  # draws dozens of figures
def test_odd_provenance_of_records_is_tolerated_or_one_error(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(style, "save", lambda figure, path: path)
    record = dynsim.simulate(load_scenario("single_pendulum", overrides={"duration_s": 0.2, "metrics.settle_s": 0.0}))
    record.provenance = {"scenario": "x"}
    # A title needs no name.
    assert figures.draw(record, tmp_path)
    assert figures.draw_comparison({"a": record}, tmp_path)
    snake = dynsim.simulate(load_scenario("snake_circle", overrides={"duration_s": 0.2, "record.rate_hz": 50}))
    snake.scene = None
    for odd in ({}, {"snake": []}, {"snake": {"head_joints": 6}}):
        snake.provenance = odd
        with pytest.raises(RecordError):
            figures.draw(snake, tmp_path)


def test_plot_names_the_record_that_lacks_something(tmp_path: Path, monkeypatch, capfd) -> None:
    from dynsim import cli

    record = dynsim.simulate(load_scenario("elbow_comparison", overrides={"duration_s": 0.05, "metrics.settle_s": 0}))
    path = lacking(record, "heat_joule").save(tmp_path / "record.h5")
    monkeypatch.setattr("sys.argv", ["dynsim", "plot", str(path)])
    with pytest.raises(SystemExit) as leaving:
        cli.main()
    assert leaving.value.code == 2
    (line,) = [line for line in capfd.readouterr().err.splitlines() if line.strip()]
    check_message(line, f"error: {path}", "'heat_joule'", "q")


def replayed() -> tuple[Record, Record]:
    t = np.linspace(0.0, 2.0, 101)
    simulated, measured = Record(t), Record(t)
    for record in (simulated, measured):
        record.add("q", np.sin(t)[:, None], "rad", labels=("a",))
        record.add("v", np.cos(t)[:, None], "rad/s", labels=("a",))
    return simulated, measured


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (lambda m: m.add("q", m.time, "rad"), ("rad",)),
        (lambda m: m.add("state", np.zeros((101, 2)), "1", labels=("a", "b")), ("'state'", "(101, 2)")),
        (lambda m: m.add("record_time", np.zeros((101, 1)), "s", labels=("a",)), ("'record_time'", "(101, 1)")),
        (lambda m: m.provenance.update(speed="fast"), ("speed", "'fast'")),
        (lambda m: m.provenance.update(speed=0), ("speed", "0")),
    ],
)
def test_compare_refuses_what_is_no_measured_run(change: Any, names: tuple[str, ...]) -> None:
    simulated, measured = replayed()
    assert compare_records(simulated, measured).worst.rms < 1e-12
    change(measured)
    with raises(RecordError, *names):
        compare_records(simulated, measured)


def test_export_refuses_motion_without_columns_and_endless_rates(tmp_path: Path) -> None:
    record, _ = replayed()
    with raises(RecordError, "--rate", "inf"):
        export_record(record, tmp_path / "a.csv", "csv", rate=float("inf"))
    with raises(RecordError, "--rate", "1e+09", "2e+09"):
        export_record(record, tmp_path / "a.csv", "csv", rate=1e9)
    record.add("v", record.time, "rad/s")
    with raises(RecordError, "'q'", "(101, 1)", "'v'", "(101,)"):
        export_record(record, tmp_path / "a.csv", "csv")


@pytest.mark.parametrize(("signal", "quantity"), [("q", "position"), ("v", "rate")])
def test_export_refuses_a_motion_that_is_not_finite(signal: str, quantity: str, tmp_path: Path) -> None:
    record, _ = replayed()
    record.add("v", record["q"].copy(), "rad/s", labels=record.labels["q"])
    record[signal][7, 0] = np.nan
    with raises(RecordError, quantity, record.labels["q"][0], "nan", "7", "0.14 s"):
        export_record(record, tmp_path / "a.csv", "csv", rate=10.0)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(("sample", "value"), [(100, np.inf), (0, -np.inf), (0, np.nan), (50, np.nan)])
def test_times_that_are_none_are_refused(sample: int, value: float) -> None:
    record = Record(np.linspace(0.0, 2.0, 101))
    record.time[sample] = value
    with raises(CheckRefused, str(value), str(sample), "101"):
        check_motion(record, load_servo_map("arm"))


def test_provenance_does_without_the_metadata_of_a_library_and_finds_the_commit_of_a_submodule(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "LIBRARIES", ("numpy", "no_such_library"))
    made_by = recording.provenance(load_scenario("single_pendulum"))
    assert made_by["libraries"] == {"numpy": np.__version__, "no_such_library": "unknown"}
    package = tmp_path / "outer" / "inner" / "dynsim" / "engine"
    git = tmp_path / "outer" / ".git" / "modules" / "inner"
    package.mkdir(parents=True)
    git.mkdir(parents=True)
    (tmp_path / "outer" / "inner" / ".git").write_text("gitdir: ../.git/modules/inner\n")
    (git / "HEAD").write_text("0123abcd\n")
    monkeypatch.setattr(recording, "__file__", str(package / "provenance.py"))
    recording.commit.cache_clear()
    assert recording.commit() == "0123abcd"
    (git / "HEAD").write_bytes(b"\xff\xfe")
    recording.commit.cache_clear()
    assert recording.commit() == ""
    recording.commit.cache_clear()


def test_an_initial_angle_without_digits_is_refused():
    with raises(ScenarioError, "plant.chain.0.initial_deg", "1e+06"):
        build_model(load_scenario("single_pendulum", overrides={"plant.chain.0.initial_deg": 2**64}))
