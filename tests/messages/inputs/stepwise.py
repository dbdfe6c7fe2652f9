"""Simulations that are advanced step by step, and linear models of them."""

from messages.case import Calls

AREA = "Python: Simulation"
ORDER = 110

TABLES = [
    Calls(
        [
            ("advance to a text", "simulation.advance('x')"),
            ("advance into the past", "simulation.advance(-1.0)"),
            ("advance to a time that is not a number", "simulation.advance(math.nan)"),
            ("end before the start", "dynsim.Simulation(arm, duration=-1.0)"),
            ("trace of minus one sample", "dynsim.Simulation(arm, trace=-1)"),
            ("number as state", "dynsim.Simulation(arm, state=7)"),
            ("state of another robot", "dynsim.Simulation(arm, state=dynsim.State.of(pendulum))"),
            ("kinematic snake step by step", "dynsim.Simulation(dynsim.load_scenario('snake_circle'))"),
            ("simulation of a file name", "dynsim.Simulation('elbow_comparison')"),
            ("command that is a text", "simulation.set_command('joint_1', 'a')"),
            ("reference of a joint that does not exist", "simulation.set_reference('joint_x', 0.0)"),
            ("reference that is infinite", "simulation.set_reference('joint_1', math.inf)"),
            ("reference of motor 99", "simulation.set_lines(np.array([99]), [[0.0, 0.0]])"),
            ("wrench on a body that does not exist", "simulation.set_wrench('hand')"),
            ("force of a single component", "simulation.set_wrench('link_1', force=[1.0])"),
            ("event that does not exist", "simulation.watch('angle', 'joint_1')"),
            ("event of a contact that does not exist", "simulation.watch('contact_gap', 'toe')"),
            ("event at a value that is not a number", "simulation.watch('joint_rate', 'joint_1', math.nan)"),
            ("period of zero", "simulation.every(0.0, print)"),
            ("very many ticks", "[simulation.every(1.0, print, first=9.0) for _ in range(61)]"),
            (
                "callback that advances its simulation",
                "simulation.every(0.01, lambda own: own.advance(0.1)); simulation.advance(0.05)",
            ),
            ("restore from nothing", "simulation.restore(None)"),
            ("restore from another simulation", "simulation.restore(dynsim.Simulation(arm).snapshot())"),
            ("mode of a motor that is not a servo", "simulation.set_mode('joint_1', 'off')"),
            ("negative supply voltage", "simulation.set_supply(-1.0)"),
            ("brake of a joint that does not exist", "simulation.set_brake('joint_11', True)"),
            ("tie that does not exist", "simulation.set_tie('spring', stiffness=1.0)"),
            ("samples that end in the past", "simulation.advance(0.02); simulation.end_samples(0.01)"),
            ("linear model with an unknown input", "free.linearize(inputs=['current'])"),
            ("linear model with an unknown output", "free.linearize(outputs=['hand'])"),
            ("linear model with time stepping", "stepped.linearize()"),
            ("event with time stepping", "stepped.watch('joint_rate', 'joint_1', 0.0)"),
            (
                "operator of a scenario without operator",
                "dynsim.Simulation(arm, operator=object())",
            ),
        ]
    ),
]
