"""Drive laws of all kinds of motors: references, commands, torques, and linear blocks for implicit methods.

The laws of each kind are plain scalar functions of (parameter table, row, reference, state), compiled unchanged.
Virtual servos call them without numba; tests call them with complex numbers (complex-step derivatives). Their
comparisons therefore use real parts. A drive kind is a constant in dynsim.dynamics.tables, a group of such functions, a
branch in each function below that depends on the kind, and one in ``dynsim.compile.tables.compile_drives``.
"""

from __future__ import annotations

from dynsim.dynamics import tables as ka
from dynsim.dynamics.state import StateLayout
from dynsim.dynamics.tables import DriveArrays, ReferenceArrays, Workspace
from dynsim.jit.kernel import inline_kernel, internal_kernel, kernel, noinline_kernel

# Clipping of values to ±limit, for every kind of drive.


def clipped(x, limit):
    """Return x clipped to ±limit, by its real part; NaN is kept."""
    if x.real > limit:
        return limit
    if x.real < -limit:
        return -limit
    return x


# DC motor with its circuit, and PD control of its terminal voltage ([WM] eqs 16–26, 56).


def dc_command(motor, a, q_ref, v_ref, q, v):
    """Return u = k_p (q_d − q) + k_d (v_d − v) [V], before its limit ([WM] eq 56)."""
    return motor[a, ka.K_P] * (q_ref - q) + motor[a, ka.K_D] * (v_ref - v)


def within_current(u, v, k_m, drop):
    """Return the voltage u [V], clipped so that the current stays within its limit; may exceed the voltage limit.

    ``drop`` is R I of the current limit [V].
    """
    back = k_m * v
    return back + clipped(u - back, drop)


def dc_torque(motor, a, i):
    """Return K_m i [N m] ([WM] eq 19); the losses of the rotor and the gear are counted at the joint."""
    return motor[a, ka.K_M] * i


def dc_balance(motor, a, u, v, i):
    """Return L di/dt = u − R i − K_m v [V] ([WM] eqs 24, 26)."""
    return u - motor[a, ka.RESISTANCE] * i - motor[a, ka.K_M] * v


def dc_block(motor, a, follows):
    """Return ∂τ/∂(q, v, i) and ∂(di/dt)/∂(q, v, i); ``follows`` is 1 if the voltage follows the state, otherwise 0."""
    inductance = motor[a, ka.INDUCTANCE]
    return (
        0.0,
        0.0,
        motor[a, ka.K_M],
        -follows * motor[a, ka.K_P] / inductance,
        -(follows * motor[a, ka.K_D] + motor[a, ka.K_M]) / inductance,
        -motor[a, ka.RESISTANCE] / inductance,
    )


# Position servo: voltage loop, motor without inductance, limits of voltage and current, friction of the gear.


def servo_command(motor, a, mode, q_ref, v_ref, q, v):
    """Return the voltage that the loop commands [V], before its limit."""
    if mode == ka.VELOCITY_MODE:
        return motor[a, ka.K_V] * (v_ref - v) + motor[a, ka.K_M] * v
    return motor[a, ka.K_P] * (q_ref - q) + motor[a, ka.K_D] * (v_ref - v)


def servo_segment(motor, a, mode, command, v):
    """Return the limit that is active for a command and a rate: 0 none, ±1 voltage, ±2 current."""
    if mode == ka.OFF:
        return 0
    u = clipped(command, motor[a, ka.U_MAX])
    wanted = (u - motor[a, ka.K_M] * v) / motor[a, ka.RESISTANCE]
    if wanted.real > motor[a, ka.I_MAX]:
        return 2
    if wanted.real < -motor[a, ka.I_MAX]:
        return -2
    if command.real > motor[a, ka.U_MAX]:
        return 1
    return -1 if command.real < -motor[a, ka.U_MAX] else 0


def servo_circuit_on(motor, a, mode, segment, command, v):
    """Return the result of :func:`servo_circuit` as if the limit ``segment`` of :func:`servo_segment` were active."""
    if mode == ka.OFF:
        return motor[a, ka.K_M] * v, 0.0 * v
    if segment == 2 or segment == -2:
        i = motor[a, ka.I_MAX] if segment > 0 else -motor[a, ka.I_MAX]
        return motor[a, ka.RESISTANCE] * i + motor[a, ka.K_M] * v, i
    u = command if segment == 0 else motor[a, ka.U_MAX] if segment > 0 else -motor[a, ka.U_MAX]
    return u, (u - motor[a, ka.K_M] * v) / motor[a, ka.RESISTANCE]


def servo_circuit(motor, a, mode, command, v):
    """Return the terminal voltage u [V] and the current i [A] for a command, both within their limits."""
    return servo_circuit_on(motor, a, mode, servo_segment(motor, a, mode, command, v), command, v)


def servo_drag(motor, a, mode, v):
    """Return the gear friction that opposes v [N m]: Coulomb friction smoothed below v_s, plus viscous drag if off."""
    drag = motor[a, ka.COULOMB] * v / (v * v + motor[a, ka.COULOMB_SPEED] ** 2) ** 0.5
    if mode == ka.OFF:
        drag += motor[a, ka.FREE_DRAG] * v
    return drag


def servo_torque(motor, a, mode, command, v):
    """Return K_m i − drag [N m] of a command."""
    _, i = servo_circuit(motor, a, mode, command, v)
    return motor[a, ka.K_M] * i - servo_drag(motor, a, mode, v)


def servo_block_on(motor, a, mode, segment, sampled, v):
    """Return ∂τ/∂(q, v) at this limit; a ``sampled`` command does not follow the state."""
    smoothing = motor[a, ka.COULOMB_SPEED] ** 2
    by_q, by_v = 0.0, -motor[a, ka.COULOMB] * smoothing / (v * v + smoothing) ** 1.5
    if mode == ka.OFF:
        return by_q, by_v - motor[a, ka.FREE_DRAG]
    if -2 < segment < 2:
        slope = motor[a, ka.K_M] / motor[a, ka.RESISTANCE]
        by_v -= slope * motor[a, ka.K_M]
        if not sampled and segment == 0:
            if mode == ka.VELOCITY_MODE:
                by_v += slope * (motor[a, ka.K_M] - motor[a, ka.K_V])
            else:
                by_q -= slope * motor[a, ka.K_P]
                by_v -= slope * motor[a, ka.K_D]
    return by_q, by_v


def servo_block(motor, a, mode, sampled, command, v):
    """Return ∂τ/∂(q, v) at a command; a ``sampled`` command does not follow the state."""
    return servo_block_on(motor, a, mode, servo_segment(motor, a, mode, command, v), sampled, v)


# Ideal torque source, whose reference is the torque itself, clipped to its limit.


def open_torque(motor, a, command):
    """Return τ [N m]: the command clipped to the limit."""
    return clipped(command, motor[a, ka.I_MAX])


_DC_LAWS = clipped, dc_balance, dc_block, dc_command, dc_torque, open_torque
_SERVO_LAWS = servo_segment, servo_circuit_on, servo_circuit, servo_block_on, servo_block
for _law in (*_DC_LAWS, *_SERVO_LAWS, servo_command, servo_drag, servo_torque):
    internal_kernel(_law)
# Do not inline this function: few motors use it, and the compiler would share its product K_m v with the balance, whose
# last bits would then change.
noinline_kernel(within_current)


@internal_kernel
def evaluate_reference(drives: DriveArrays, reference: ReferenceArrays, t, ws: Workspace):
    """Write references q_d and rates v_d of all drives at time t to ``ws.motors`` [rad, rad/s; torque sources: N m]."""
    motors, c, line = ws.motors, reference.coefficients, drives.input
    spacing = reference.grid[1]
    x = t - reference.grid[0]
    segment = min(max(int(x / spacing), 0), c.shape[0] - 1)
    x -= segment * spacing
    for a in range(motors.shape[0]):
        s = reference.spline[a]
        if s == ka.REWRITTEN:
            motors[a, ka.Q_REF] = line[a, ka.LINE_START] + line[a, ka.LINE_RATE] * (t - line[a, ka.LINE_SINCE])
            motors[a, ka.V_REF] = line[a, ka.LINE_RATE]
        elif s < 0:
            motors[a, ka.Q_REF] = reference.held[a]
            motors[a, ka.V_REF] = 0.0
        else:
            c0, c1, c2 = c[segment, s, 0], c[segment, s, 1], c[segment, s, 2]
            c3, c4, c5 = c[segment, s, 3], c[segment, s, 4], c[segment, s, 5]
            motors[a, ka.Q_REF] = c0 + x * (c1 + x * (c2 + x * (c3 + x * (c4 + x * c5))))
            motors[a, ka.V_REF] = c1 + x * (2.0 * c2 + x * (3.0 * c3 + x * (4.0 * c4 + x * 5.0 * c5)))


@internal_kernel
def command(drives: DriveArrays, ws: Workspace, a):
    """Return the command of drive a, by its law at the present state, before limits [V; N m for an open torque]."""
    motor, i, kind = drives.motor, drives.table[a, ka.DRIVEN], drives.table[a, ka.DRIVE_KIND]
    q_ref, v_ref = ws.motors[a, ka.Q_REF], ws.motors[a, ka.V_REF]
    if kind == ka.DC_MOTOR:
        return dc_command(motor, a, q_ref, v_ref, ws.joints[i, ka.Q], ws.joints[i, ka.QD])
    if kind == ka.POSITION_SERVO:
        return servo_command(
            motor, a, drives.table[a, ka.SERVO_MODE], q_ref, v_ref, ws.joints[i, ka.Q], ws.joints[i, ka.QD]
        )
    return q_ref


@internal_kernel
def fed_forward(voltage, grid, t, a, asked):
    """Add the planned voltage of a drive, if any, to its command; the last value applies after the end of the plan."""
    if voltage.shape[0] == 0:
        return asked
    x = min(t - grid[0], voltage.shape[0] * grid[1])
    k = min(max(int(x / grid[1]), 0), voltage.shape[0] - 1)
    x -= k * grid[1]
    total = 0.0
    for power in range(5, -1, -1):
        total = total * x + voltage[k, a, power]
    return asked + total


# Inlined, because a call for each motor would take a fourteenth of an explicit step.
@inline_kernel
def drive_dc(drives: DriveArrays, asked, i, ws: Workspace, a):
    """Evaluate DC motor a at a command [V] and a current [A]."""
    motors, motor, j = ws.motors, drives.motor, drives.table[a, ka.DRIVEN]
    u = clipped(drives.input[a, ka.COMMAND] if drives.table[a, ka.SAMPLED] else asked, motor[a, ka.U_MAX])
    if drives.table[a, ka.CURRENT_LIMITED] != 0:
        u = within_current(u, ws.joints[j, ka.QD], motor[a, ka.K_M], motor[a, ka.RESISTANCE] * motor[a, ka.I_MAX])
    motors[a, ka.CURRENT], motors[a, ka.VOLTAGE] = i, u
    motors[a, ka.DIDT] = dc_balance(motor, a, u, ws.joints[j, ka.QD], i) / motor[a, ka.INDUCTANCE]
    ws.joints[j, ka.APPLIED] += dc_torque(motor, a, i)


@internal_kernel
def drive(drives: DriveArrays, reference: ReferenceArrays, t, y, layout: StateLayout, ws: Workspace):
    """Write currents, voltages and current rates of all drives to ``ws.motors``; add their torques to ``ws.joints``.

    ``ws.joints`` must already contain the joint positions and rates and the other applied forces.
    """
    table, motor, motors, joints = drives.table, drives.motor, ws.motors, ws.joints
    na = motors.shape[0]
    evaluate_reference(drives, reference, t, ws)
    if layout.circuits == na:  # every drive has a circuit, as in most robots
        for a in range(na):
            j = table[a, ka.DRIVEN]
            asked = dc_command(motor, a, motors[a, ka.Q_REF], motors[a, ka.V_REF], joints[j, ka.Q], joints[j, ka.QD])
            asked = fed_forward(reference.voltage, reference.grid, t, a, asked)
            drive_dc(drives, asked, y[layout.current + a], ws, a)
        return
    for a in range(na):
        j, kind = table[a, ka.DRIVEN], table[a, ka.DRIVE_KIND]
        v = joints[j, ka.QD]
        asked = asked_of(drives, reference, t, ws, a)
        if kind == ka.DC_MOTOR:
            drive_dc(drives, asked, y[layout.current + table[a, ka.CIRCUIT]], ws, a)
        elif kind == ka.POSITION_SERVO:
            mode = drives.table[a, ka.SERVO_MODE]
            motors[a, ka.VOLTAGE], motors[a, ka.CURRENT] = servo_circuit(motor, a, mode, asked, v)
            motors[a, ka.DRAG] = servo_drag(motor, a, mode, v)
            joints[j, ka.APPLIED] += motor[a, ka.K_M] * motors[a, ka.CURRENT] - motors[a, ka.DRAG]
        else:
            motors[a, ka.VOLTAGE], motors[a, ka.CURRENT] = v, open_torque(motor, a, asked)
            joints[j, ka.APPLIED] += motors[a, ka.CURRENT]


@kernel
def take_commands(drives: DriveArrays, reference: ReferenceArrays, t, ws: Workspace):
    """Take the commands of all sampled drives at a tick, at the state in ``ws.joints``; they are held from now on.

    The caller may have put measured joint states there.
    """
    evaluate_reference(drives, reference, t, ws)
    for a in range(ws.motors.shape[0]):
        if drives.table[a, ka.SAMPLED] == ka.AT_TICKS:
            asked = command(drives, ws, a)
            drives.input[a, ka.COMMAND] = fed_forward(reference.voltage, reference.grid, t, a, asked)


@kernel
def follow_lines(spline, table, line, sampled, motors, lines, t):
    """Set linear references of motors from time t on: positions and rates, (m, 2), instead of planned references.

    ``sampled``, (na,), is the scenario's entry of each motor in ``table``. Returns False and changes nothing if a motor
    of ``motors``, (m,), does not exist.
    """
    count = spline.shape[0]
    for k in range(motors.shape[0]):
        if not -count <= motors[k] < count:
            return False
    for k in range(motors.shape[0]):
        a = motors[k]
        spline[a], table[a, ka.SAMPLED] = ka.REWRITTEN, sampled[a]
        line[a, ka.LINE_START], line[a, ka.LINE_RATE], line[a, ka.LINE_SINCE] = lines[k, 0], lines[k, 1], t
    return True


@internal_kernel
def drive_block(drives: DriveArrays, ws: Workspace, a, limit, block):
    """Write ∂τ/∂(q, v, i) and ∂(di/dt)/∂(q, v, i) of drive a at this limit to the row ``block``, (BLOCK_SIZE,)."""
    motor, kind, mode = drives.motor, drives.table[a, ka.DRIVE_KIND], drives.table[a, ka.SERVO_MODE]
    sampled = drives.table[a, ka.SAMPLED] != 0
    block[:] = 0.0
    if kind == ka.DC_MOTOR:
        slopes = dc_block(motor, a, 1.0 if limit == 0 and not sampled else 0.0)
        block[ka.TORQUE_Q], block[ka.TORQUE_V], block[ka.TORQUE_I] = slopes[0], slopes[1], slopes[2]
        block[ka.RATE_Q], block[ka.RATE_V], block[ka.RATE_I] = slopes[3], slopes[4], slopes[5]
        if limit == 2 or limit == -2:
            block[ka.RATE_Q], block[ka.RATE_V] = 0.0, 0.0
    elif kind == ka.POSITION_SERVO:
        v = ws.joints[drives.table[a, ka.DRIVEN], ka.QD]
        block[ka.TORQUE_Q], block[ka.TORQUE_V] = servo_block_on(motor, a, mode, limit, sampled, v)


@internal_kernel
def asked_of(drives: DriveArrays, reference: ReferenceArrays, t, ws: Workspace, a):
    """Return the command of drive a at the present state and time t, before limits, after ``evaluate_reference``."""
    if drives.table[a, ka.SAMPLED] != 0:
        return drives.input[a, ka.COMMAND]
    asked = command(drives, ws, a)
    if drives.table[a, ka.DRIVE_KIND] == ka.DC_MOTOR:
        return fed_forward(reference.voltage, reference.grid, t, a, asked)
    return asked


@internal_kernel
def segment_of(drives: DriveArrays, reference: ReferenceArrays, t, ws: Workspace, a):
    """Return the active limit of drive a at the present state: 0 none, ±1 voltage, ±2 current."""
    motor, asked = drives.motor, asked_of(drives, reference, t, ws, a)
    if drives.table[a, ka.DRIVE_KIND] == ka.POSITION_SERVO:
        v = ws.joints[drives.table[a, ka.DRIVEN], ka.QD]
        return servo_segment(motor, a, drives.table[a, ka.SERVO_MODE], asked, v)
    if drives.table[a, ka.DRIVE_KIND] == ka.DC_MOTOR:
        u = clipped(asked, motor[a, ka.U_MAX])
        over = u - motor[a, ka.K_M] * ws.joints[drives.table[a, ka.DRIVEN], ka.QD]
        if drives.table[a, ka.CURRENT_LIMITED] != 0 and abs(over) > motor[a, ka.RESISTANCE] * motor[a, ka.I_MAX]:
            return 2 if over > 0.0 else -2
        return 1 if asked > motor[a, ka.U_MAX] else -1 if asked < -motor[a, ka.U_MAX] else 0
    return 0


@internal_kernel
def drive_on_segments(
    drives: DriveArrays, reference: ReferenceArrays, t, y, layout: StateLayout, segment, ws: Workspace, linear
):
    """Evaluate :func:`drive` and :func:`drive_block` as if the limits ``segment``, (na,), were active.

    Parameters
    ----------
    linear : (na, BLOCK_SIZE) ndarray
        Overwritten with the linear blocks.
    """
    table, motor, motors, joints = drives.table, drives.motor, ws.motors, ws.joints
    evaluate_reference(drives, reference, t, ws)
    for a in range(motors.shape[0]):
        j, kind, mode, limit = table[a, ka.DRIVEN], table[a, ka.DRIVE_KIND], table[a, ka.SERVO_MODE], segment[a]
        v, asked = joints[j, ka.QD], asked_of(drives, reference, t, ws, a)
        drive_block(drives, ws, a, limit, linear[a])
        if kind == ka.DC_MOTOR:
            i, u = y[layout.current + table[a, ka.CIRCUIT]], asked
            if limit == 1 or limit == -1:
                u = motor[a, ka.U_MAX] * limit
            elif limit != 0:
                u = motor[a, ka.K_M] * v + 0.5 * limit * motor[a, ka.RESISTANCE] * motor[a, ka.I_MAX]
            motors[a, ka.CURRENT], motors[a, ka.VOLTAGE] = i, u
            motors[a, ka.DIDT] = dc_balance(motor, a, u, v, i) / motor[a, ka.INDUCTANCE]
            joints[j, ka.APPLIED] += dc_torque(motor, a, i)
        elif kind == ka.POSITION_SERVO:
            motors[a, ka.VOLTAGE], motors[a, ka.CURRENT] = servo_circuit_on(motor, a, mode, limit, asked, v)
            motors[a, ka.DRAG] = servo_drag(motor, a, mode, v)
            joints[j, ka.APPLIED] += motor[a, ka.K_M] * motors[a, ka.CURRENT] - motors[a, ka.DRAG]
        else:
            motors[a, ka.VOLTAGE], motors[a, ka.CURRENT] = v, open_torque(motor, a, asked)
            joints[j, ka.APPLIED] += motors[a, ka.CURRENT]
