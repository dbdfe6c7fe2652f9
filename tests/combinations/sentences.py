"""What dynsim says, as far as these checks read it: the only wordings that they know.

A sentence of the package that is reworded changes one line here.
"""

from __future__ import annotations

NUMBER = r"([-+]?[0-9.]+(?:e[-+]?[0-9]+)?|inf|-inf|nan)"

# Parts of errors.
CANNOT_DRIVE = "cannot drive"
COUPLED = "not for robots with coupled joints"
DO_NOT_BRING = "the joints that may move do not bring"
NOTHING_HOLDS = "nothing holds this posture"
NO_WAYPOINTS = "no joint has waypoints"
OFF_SURFACE = "from surface"
REFERENCES_OFF = "the references take .* off surface"

# Parts of warnings and stops.
DRIFTED = "contacts drifted"
FRICTION_GIVES = "friction has put"
IMMOBILE = ": no joint moves this point along the normal"
INCOMPLETE = "incomplete: "
JUMPS = "that jumps at the start all the same"
LEDGER = "the energy ledger does not close"
MOVED_BACK = "has moved it back"
OTHER_FORCES = "contacts with other forces than at rest"
SHARED = "shared forces"
SLIPS_AT_START = "the start slips at"
STEPS_MADE = "the steps themselves made"
STILL_BEYOND = "it is still"
UNSTABLE = "the sampled loop is unstable"
WEDGED = "friction can wedge"
# A motion which is not unique.
NOT_UNIQUE = (
    "leave the motion open",
    "the motion is not unique",
    "other choices may move otherwise",
    "chatter",
    "turns its own force against it",
)

# Numbers and names within sentences.
AT_TIME = rf"(\S+) \({NUMBER} s\)"
BY_AMOUNT = rf"(\S+) by {NUMBER}"
FROM_THEN_ON = rf"from t = {NUMBER} s on"
GROWTH_PER_PERIOD = rf"{UNSTABLE}.*?deviations grow (\S+) times per period"
HOLDS_UP = (
    rf"steps are as short as {NUMBER} s because (\S+) slips at {NUMBER} m/s and its friction changes within {NUMBER} "
    rf"s; integrator.method: radau5"
)
INSTEAD_OF = rf"(\S+) {NUMBER} N instead of"
LAST_STEP = rf"the last step of {NUMBER} s"
MOVED = r"initial.equilibrium: moves (.+) from the requested posture"
OVERLOAD = rf"(?:^|, )(\S+) {NUMBER} of "
SHARE_OF_RUN = rf"(\S+) \({NUMBER} % of the run\)"
STEP_FELL = rf"the step size fell to {NUMBER} s"
WEDGE = rf"(\S+) against \S+ from a coefficient of {NUMBER} on \(it has {NUMBER}, t = {NUMBER} s\)"

# Warnings that a check verifies, by what they say.
SENTENCES: dict[str, str] = {
    "chatter of a contact": rf"^(.+): chatter, more than {NUMBER} contact events within {NUMBER} s",
    "chatter of a stop": rf"^(.+): chatter, more than {NUMBER} events of its stop within {NUMBER} s",
    "pulls": rf"^(.+): the (.+) pulls on this brace for {NUMBER}(?: %)? of the run, with up to {NUMBER} N",
    "pulls between": rf"^(.+): pulls with up to {NUMBER} N within a step",
    "never touches": rf"^(.+): this brace never touches the (.+): it carries nothing; nearest {NUMBER} mm",
    "never pressed": r"^(.+): this brace is on the (.+) at (.+), but never pressed",
    "reversed": rf"^(.+): from t = {NUMBER} s on, its friction turns its own force against it",
    "friction gives": rf"^friction has put {NUMBER} J into the arm",
    "at limit": rf"^(.+): (\S+) at its limit of {NUMBER} \S+(?: m)? for {NUMBER} % of the run",
    "passes limit": rf"^(.+): passes its (.+) limit of .*first at t = {NUMBER} s",
    "does not close": r"^the energy ledger does not close",
    "drifted": rf"^contacts drifted by {NUMBER} m",
    "scheme": rf"^time stepping: the steps themselves \S+ up to {NUMBER} J",
    "gains": rf"^time stepping: contacts or ties that give way get {NUMBER} J from the steps",
    "sinks": rf"^time stepping: points sink up to {NUMBER} mm",
    "shared with dry friction": r"^(.*): shared forces with the dry friction of (.+), which keeps? these joints",
    "shared by joints": r"^(.+): shared forces of the dry friction which keeps these coupled joints at rest",
    "shared": r"^(.*): shared forces which the motion does not determine()",
    "below": rf" below (.+?)(?: by more than the link's radius)?: (\S+?),?(?: of .*)? by up to {NUMBER} mm in the",
    "reference beyond": r"^(.+): its reference goes beyond its stop",
    "overloaded": r"^(.+): the (\S+), rms over the run, is more than nominal",
    "tips at the start": (
        rf"^a jolt of the start takes the tip margin below zero.*? in {NUMBER}(?: % of the samples)?[,;]"
    ),
    "tips": rf"^the base (?:tips over|is tipped over|1) at t = .*below zero in {NUMBER}(?: % of the samples)?[,;]",
    "lifted": rf"^the base is lifted: no load on its wheels and caster in {NUMBER}(?: %)? of the samples",
    "would slip": rf"^the (\S+) wheel would slip: it needs up to {NUMBER} times the traction",
    "left out": r"^(?:contacts\.points\.)?(.+): no joint moves this point along the normal of",
    "jumps": r"^initial.equilibrium: .*that jumps at the start",
    "unstable": rf"^controller.sample_time_s = {NUMBER} s: the sampled loop is unstable",
    "unpressed": r"^the motion is not unique: nothing presses (.+), held by",
    "leaves in impact": (
        r"^the motion is not unique: impacts of other points or joint stops, .+?, lift (.+) off, while"
    ),
    "wedged": r"^the motion is not unique: friction can wedge (.+) by itself, without a load",
    "moved at the start": r"^initial.equilibrium: moves (.+) from the requested posture",
    "moves at once": rf"^initial.equilibrium: (\S+) starts with {NUMBER} \S+ all the same.*",
    "slips at once": rf"^initial.equilibrium: the start slips at t = {NUMBER} s",
    "not carried out": rf"^operator: {NUMBER} m of the {NUMBER} m that the hand was commanded to go were not",
}
UNVERIFIED: dict[str, str] = {
    r"contact problems were given up above": "the solver's count; forces and cones are checked",
    r"^contact rows depended on each other in": "the solver's count of evaluations",
    r"with friction, dependent contact rows leave the motion open too": "a range over splits, of which the run has one",
    r"^time stepping: the power changes so fast": "a sum over all steps, of which samples show some",
    r"no joint without a closed brake moves this point": "of brakes, which these scenes do not close",
    r"has no effect: ": "said of a key of the scenario, not of the run",
    r"^the target waited|^the path is|^feedback and shape points|^the null-space|^joints were clamped|^the robot tips|"
    r"^the support margin|^mode \d+ was|passes its limit by|"
    r"^the head is up to": "for the kinematic snake, which these scenes do not have",
}
"""Warnings that nothing outside the engine can tell, each with the reason."""
# Sentences of the modules that make warnings which end as part of an error, of a stop, or of another sentence.
PARTS = (
    r"^joint .* moves no inertia in this posture",
    r"^plant: ",
    r"; until then they could grow by a factor|; from t = 1 s on deviations have had the time to grow",
    r"^use .*, which is stable, or smaller gains",
    r"^the .* of .* begins with|^the reference of .* begins|^the planned voltages count on",
    r"^the motion does not determine|^in the samples",
    r"^; (?:while|where) .*, other choices may move otherwise",
    r"^f_t = |^friction has put ",
    r"^, and contacts with other forces than at rest",
    r"^of the start|^stops are enforced",
    r"; a shorter integrator.step_s lets it pass less$|^it is still .* beyond its stop at the end$",
    r"^k_[pv] = ",
    r"^\S+ against \S+ from a coefficient of",
)

# Warnings that are not true of the plain arm of test_checks; no check knows the last one.
FALSE_WARNINGS = (
    "tip: this brace never touches the floor: it carries nothing; nearest 3 mm at t = 0 s",
    "joint_1: voltage at its limit of 24 V for 50.0 % of the run",
    "joint_3: passes its lower position limit of 0° (0 rad) by up to 1° (0.02 rad), first at t = 0.1 s; no law",
    "the energy ledger does not close: residual 1.0e-03 of the turnover; tighten integrator.rtol or the step",
    "friction has put 0.3 J into the arm: an error of the integration; shorten integrator.step_s",
    "tip: chatter, more than 200 contact events within 1 s; what left more slowly was kept on the surface",
    "bend: chatter, more than 200 events of its stop within 1 s; what left more slowly was kept on the stop",
    "joint_1 9 of 2 A: the current, rms over the run, is more than nominal, which a motor does not stand for long",
    "link_2 passes below floor by more than the link's radius: link_2, of 10 mm, by up to 90 mm in the samples, first",
    "operator: 0.2 m of the 0.4 m that the hand was commanded to go were not carried out, mostly from t = 1 s on",
    "an unknown warning",
)
