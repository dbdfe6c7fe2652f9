"""A sample at a tick of a sampled controller has the values that are in force from that tick on."""

from __future__ import annotations

import numpy as np
import pytest

from dynsim import Simulation, load_scenario, simulate, simulate_batch
from dynsim.record import Record
from dynsim.scenario import build

PERIOD = 4e-3
K_P, K_D, LIMIT = 40.0, 2.0, 6.0
# Two samples in each period: at the tick and in its middle.
ARM = f"""
duration_s: 0.2
plant:
  type: serial_arm
  link: {{length_m: 0.3, mass_kg: 0.5, motor: {{type: wang_minami, voltage_limit_V: {LIMIT}}}}}
  chain: [{{count: 2}}]
  initial_deg: [20, -40]
controller: {{type: joint_pd, k_p_V_per_rad: {K_P}, k_d_V_s_per_rad: {K_D}, sample_time_s: {PERIOD}}}
record: {{rate_hz: {2 / PERIOD}}}
metrics: {{settle_s: 0}}
"""
REAL = {"contacts.law": "unilateral"}
METHODS = [
    {"integrator.method": "dopri5"},
    {"integrator.method": "radau5"},
    {"integrator.method": "auto"},
    {"integrator.method": "dopri5", **REAL},
    {"integrator.method": "radau5", **REAL},
    {"integrator.method": "time_stepping", "integrator.step_s": 0.001, **REAL},
]
SERVO = {"type": "servo", "voltage_V": 12.0, "stall_torque_N_m": 8.0, "no_load_speed_rad_per_s": 5.0}


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text(ARM)
    return lambda **changes: load_scenario(path, None, {k.replace("__", "."): v for k, v in changes.items()})


def commanded(record: Record, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The voltage law with references that hold at the start, (…, 2) [V]."""
    return np.clip(K_P * (record["q"][0] - q) - K_D * v, -LIMIT, LIMIT)


def ids(changes) -> str:
    return "-".join(str(value) for key, value in changes.items() if key != "integrator.step_s")


@pytest.mark.parametrize("method", METHODS, ids=ids)
def test_the_voltage_at_a_tick_follows_from_the_same_sample(arm, method):
    """From the first to the last; within a period the voltage of the tick holds, to the bit."""
    record = simulate(arm(**method))
    assert len(record) == 101  # the last one is at a tick, as the first is
    at_ticks = record["voltage"][::2]
    np.testing.assert_allclose(at_ticks, commanded(record, record["q"][::2], record["v"][::2]), rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(record["voltage"][1::2], at_ticks[:-1])
    assert np.abs(np.diff(at_ticks, axis=0)).max() > 0.1
    assert np.abs(at_ticks).max() < LIMIT
    np.testing.assert_array_equal(record["power"], record["voltage"] * record["current"])


@pytest.mark.parametrize("method", [METHODS[0], METHODS[5]], ids=ids)
def test_a_servo_has_current_and_torque_of_the_command_at_its_tick(tmp_path, method):
    """Without a circuit they jump with the voltage: i = (u − K_m v)/R."""
    # The gain is part of the motor.
    text = ARM.replace(f"k_p_V_per_rad: {K_P}, k_d_V_s_per_rad: {K_D}, ", "")
    (tmp_path / "arm.yaml").write_text(text)
    motor = {**SERVO, "k_p_V_per_rad": K_P}
    link = {"length_m": 0.3, "mass_kg": 0.5, "motor": motor}
    record = simulate(load_scenario(tmp_path / "arm.yaml", None, {"plant.link": link, **method}))
    off = K_P * (record["q"][0] - record["q"][::2])
    np.testing.assert_allclose(record["voltage"][::2], np.clip(off, -12.0, 12.0), rtol=0.0, atol=1e-12)
    K_m = 12.0 / 5.0
    R = K_m * 12.0 / 8.0
    expected = (record["voltage"] - K_m * record["v"]) / R
    np.testing.assert_allclose(record["current"], expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("method", METHODS, ids=ids)
@pytest.mark.parametrize("delay", [0.0, PERIOD, 2.5 * PERIOD])
def test_the_voltage_follows_from_the_measurement_in_force(arm, method, delay):
    """``q_measured`` at a tick is what the controller has at that tick, with the delay of its encoders."""
    record = simulate(arm(**method, sensors__encoders={"delay_s": delay}))
    measured = record["q_measured"][::2]
    ticks = int(np.ceil(delay / PERIOD - 1e-9))
    step = np.radians(360.0 / 4096.0)
    true = np.concatenate([np.tile(record["q"][0], (ticks, 1)), record["q"][::2][: len(measured) - ticks]])
    np.testing.assert_array_equal(measured, step * np.rint(true / step))
    rate = np.diff(measured, axis=0, prepend=measured[:1]) / PERIOD
    held = np.clip(K_P * (record["q"][0] - measured) - K_D * rate, -LIMIT, LIMIT)
    np.testing.assert_allclose(record["voltage"][::2], held, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(record["voltage"][1::2], record["voltage"][:-2:2])


@pytest.mark.parametrize("encoders", [None, {"delay_s": PERIOD}])
@pytest.mark.parametrize("method", [METHODS[0], METHODS[4], METHODS[5]], ids=ids)
def test_pieces_and_batches_have_the_same_samples(arm, method, encoders):
    """Records on the way too, whose last sample is at a tick."""
    scenario = arm(**method, **({} if encoders is None else {"sensors__encoders": encoders}))
    whole, simulation = simulate(scenario), Simulation(scenario)
    for end in (0.5 * PERIOD, 3 * PERIOD, 3.3 * PERIOD, 10 * PERIOD, 0.2):
        simulation.advance(end)
        part = simulation.record()
        # A record within a period ends an additional step there.
        for name in ("q", "v", "voltage", "current", "torque"):
            np.testing.assert_allclose(
                part[name], whole[name][: len(part)], rtol=0.0, atol=1e-6, err_msg=f"{name} {end}"
            )
    for name in whole:
        assert part[name].tobytes() == whole[name].tobytes(), name
    assert len(part) == len(whole)
    (batch,) = simulate_batch([scenario], keep_records="all")
    assert batch.record is not None
    np.testing.assert_array_equal(batch.record["voltage"], whole["voltage"])


@pytest.mark.parametrize("method", [METHODS[0], METHODS[3], METHODS[5]], ids=ids)
def test_a_caller_between_two_pieces_is_a_sampled_controller_too(arm, method):
    """A command that is set at the time of a sample is in that sample."""
    simulation = Simulation(arm(controller=None, **method))
    commands = [1.0, -2.0, 0.5]
    for k, voltage in enumerate(commands):
        simulation.set_command("joint_1", voltage)
        simulation.advance((k + 1) * PERIOD)
    record = simulation.record()
    np.testing.assert_array_equal(record["voltage"][:, 0], [*np.repeat(commands, 2), commands[-1]])


@pytest.mark.parametrize("method", [METHODS[0], METHODS[3]], ids=ids)
def test_a_load_that_jumps_is_in_the_sample_at_its_jump(arm, method):
    """Accelerations too have the values from the jump on."""
    push = {
        "type": "samples",
        "body": "link_2",
        "times_s": [0.1, 0.2],
        "force_N": [[5, 0, 0], [5, 0, 0]],
        "hold": False,
    }
    plain, pushed = simulate(arm(**method)), simulate(arm(**method, loads={"push": push}))
    k = 50  # t = 0.1 s
    np.testing.assert_allclose(pushed["q"][: k + 1], plain["q"][: k + 1], rtol=0.0, atol=1e-12)
    assert np.abs(pushed["vdot"][k - 1] - plain["vdot"][k - 1]).max() < 1e-9
    assert np.abs(pushed["vdot"][k] - plain["vdot"][k]).max() > 1.0


@pytest.mark.parametrize("method", METHODS[3:], ids=ids)
def test_a_sample_at_which_a_brake_closes_is_from_after_it(arm, method):
    """Under time stepping it had the rates, energies and losses of before."""
    simulation = Simulation(arm(**method))
    simulation.set_reference("joint_2", np.radians(-40.0), 4.0)
    simulation.advance(0.1)
    simulation.set_brake("joint_2", True)
    state = simulation.state
    simulation.advance(0.2)
    record = simulation.record()
    at = int(np.abs(record.time - 0.1).argmin())
    assert abs(record["v"][at - 1, 1]) > 0.5
    assert record["v"][at, 1] == 0.0
    np.testing.assert_allclose(record["v"][at], state.v, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(record["q"][at], state.q, rtol=0.0, atol=1e-14)
    # What the other joint has left, with its rotor of 1.64e-4 kg m² behind a gear of 3; the braked one rests.
    energy = 0.5 * (simulation.model.mass_matrix(state.q)[0, 0] + 9.0 * 1.64e-4) * state.v[0] ** 2
    assert record["energy_kinetic"][at] == pytest.approx(energy, rel=1e-12)
    assert record["loss_joint"][at] > record["loss_joint"][at - 1] + 1e-3
    # Within one period at rtol 1e-6, and the brake takes some 0.01 J.
    assert abs(record["energy_residual"][at] - record["energy_residual"][at - 1]) < 1e-7


def test_servos_of_a_snake_have_the_commands_of_their_sample():
    """u = k_p (φ_d − φ) + k_d (φ_d' − φ'), k_v (ρ_d' − ρ') + K_m ρ': from the first tick to the end of the run."""
    changes = {"plant.level": "dynamic", "duration_s": 0.3, "record.rate_hz": 200}
    changes["controller.paths"] = [
        {"type": "ramp", "start_s": 0.0, "duration_s": 0.3, "displacement": [0.02, 0, 0, 0, 0, 0.2]}
    ]
    scenario = load_scenario("snake_positioning_dynamic", "x", changes)
    record, servos = simulate(scenario), {motor.joint: motor for motor in build.robot(scenario).motors}
    voltage = dict(zip(record.labels["voltage"], record["voltage"].T, strict=True))
    for j, joint in enumerate(record.labels["phi"]):
        servo = servos[joint]
        off = record["phi_command"][:, j] - record["phi"][:, j]
        late = record["phi_dot_command"][:, j] - record["phi_dot"][:, j]
        if joint != "psi3":  # which lifts, too
            law = np.clip(servo.k_p * off + servo.k_d * late, -servo.voltage_limit, servo.voltage_limit)
            np.testing.assert_allclose(voltage[joint], law, rtol=0.0, atol=1e-11, err_msg=joint)
    wheels = [joint for joint in record.labels["voltage"] if joint.startswith("wheel")]
    assert np.abs(np.diff(record["rho_dot_command"], axis=0)).max() > 1e-3
    for k, joint in enumerate(wheels):
        servo, rate = servos[joint], record["rho_dot"][:, k]
        law = servo.k_v * (record["rho_dot_command"][:, k] - rate) + servo.torque_constant * rate
        law = np.clip(law, -servo.voltage_limit, servo.voltage_limit)
        np.testing.assert_allclose(voltage[joint], law, rtol=0.0, atol=1e-11, err_msg=joint)
