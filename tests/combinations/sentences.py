"""Sentences of dynsim that the checks read: the only wordings that they know. A reworded one changes a line here."""

from __future__ import annotations

NUMBER = r"([-+]?[0-9.]+(?:e[-+]?[0-9]+)?|inf|-inf|nan)"

# Parts of errors.
CANNOT_DRIVE = "cannot drive"
COUPLED = "coupled joints are not supported"
DO_NOT_BRING = "cannot bring"
NOTHING_HOLDS = "this posture cannot be held at rest"
NO_WAYPOINTS = "no joint has waypoints"
OFF_SURFACE = "from surface"
REFERENCES_OFF = "references move .* off surface"

# Parts of warnings and stops.
DRIFTED = "contacts drifted"
FRICTION_GIVES = "friction has added"
IMMOBILE = ": no joint moves this point along the normal"
INCOMPLETE = "incomplete: "
JUMPS = "the motion still jumps at the start"
LEDGER = "the energy ledger does not close"
MOVED_BACK = "has moved it back"
OVERLAP = "overlap by"
OTHER_FORCES = "contact forces differ from rest"
SHARED = "the motion does not determine"
SLIPS_AT_START = "the start slips at"
STEPS_MADE = "the steps themselves added"
STILL_BEYOND = "it is still"
UNSTABLE = "the sampled loop is unstable"
WEDGED = "friction alone can wedge"
# A motion which is not unique.
NOT_UNIQUE = (
    "leave the motion undetermined",
    "the motion is not unique",
    "other solutions may move differently",
    "chatter",
    "its friction reverses the effect of its normal force",
)

# Numbers and names within sentences.
AT_TIME = rf"(\S+) \({NUMBER} s\)"
BY_AMOUNT = rf"(\S+) by {NUMBER}"
FROM_THEN_ON = rf"since t = {NUMBER} s"
GROWTH_PER_PERIOD = rf"{UNSTABLE}.*?deviations grow by a factor of (\S+) per period"
HOLDS_UP = (
    rf"steps are as short as {NUMBER} s because (\S+) slips at {NUMBER} m/s and its friction changes within {NUMBER} "
    rf"s; integrator.method: radau5"
)
INSTEAD_OF = rf"(\S+) {NUMBER} N instead of"
LAST_STEP = rf"last step {NUMBER} s"
MOVED = r"initial.equilibrium: moves (.+) from the requested posture"
DUE_TO = r"{}(\S+?)(?:,| \(| under| without| at)"
OVERLOAD = rf"(?:^|, )(\S+) {NUMBER} of "
SHARE_OF_RUN = rf"(\S+) \({NUMBER} % of the run\)"
STEP_FELL = rf"the step size fell to {NUMBER} s"
WEDGE = rf"(\S+) against \S+ for coefficients of {NUMBER} or more \(here {NUMBER}, t = {NUMBER} s\)"

# Warnings that a check verifies, by what they say.
SENTENCES: dict[str, str] = {
    "chatter of a contact": rf"^(.+): chatter, more than {NUMBER} contact events within {NUMBER} s",
    "chatter of a stop": rf"^(.+): chatter, more than {NUMBER} events of its stop within {NUMBER} s",
    "pulls": rf"^(.+): the (.+) pulls on this brace for {NUMBER}(?: %)? of the run, with up to {NUMBER} N",
    "pulls between": rf"^(.+): pulls with up to {NUMBER} N within a step",
    "never touches": (
        rf"^(.+): never touches the (.+?)(?: from t = \S+ s on)? and carries no load; smallest gap {NUMBER} mm"
    ),
    "never pressed": r"^(.+): is on the (.+) at (.+), but is never pressed",
    "reversed": rf"^(.+): from t = {NUMBER} s on, its friction reverses the effect of its normal force",
    "friction gives": rf"^friction has added {NUMBER} J to the arm",
    "at limit": rf"^(.+): (\S+) at its limit of {NUMBER} \S+(?: m)? for {NUMBER} % of the run",
    "passes limit": rf"^(.+): exceeds its (.+) limit of .*first at t = {NUMBER} s",
    "does not close": r"^the energy ledger does not close",
    "drifted": rf"^contacts drifted by {NUMBER} m",
    "scheme": rf"^time stepping: the steps themselves (?:removed|added|1) up to {NUMBER} J",
    "gains": rf"^time stepping: the steps themselves add {NUMBER} J to compliant contacts or ties",
    "sinks": rf"^time stepping: points sink up to {NUMBER} mm",
    "compressed": (
        rf"^(\S+): compressed by up to (?:{NUMBER}|1) mm, more than the rounding of the edges \((?:{NUMBER}|1) mm\)"
    ),
    "passes through": rf"^(\S+): pass through each other at t = {NUMBER} s, .*fast \((?:{NUMBER} mm per step|.*);",
    "shared with dry friction": r"^(.*): forces shared with the dry friction of (.+), which keeps? these joints",
    "shared by joints": r"^(.+): shared dry friction forces keep these coupled joints at rest",
    "shared": r"^(.*): the motion does not determine how load is shared()",
    "below": (
        rf" below (.+?)(?: by more than the link's radius)?: (\S+?)(?: \(radius .*\))? by up to {NUMBER} mm in the"
    ),
    "reference beyond": r"^(.+): its reference exceeds its stop",
    "overloaded": r"^(.+): the rms (\S+) of the run exceeds the nominal",
    "tips at the start": (
        r"^a jolt at the start drives the tip margin below zero.*? "
        rf"(?:between two samples|(?:in )?{NUMBER}(?: % of the samples)?)[,;]"
    ),
    "tips": (
        r"^the base (?:tips over|is tipped over|1) at t = .*below zero "
        rf"(?:between two samples|(?:in )?{NUMBER}(?: % of the samples)?)[,;]"
    ),
    "lifted": rf"^the base is lifted: its wheels and caster carry no load in {NUMBER}(?: %)? of the samples",
    "would slip": rf"^the (\S+) wheel would slip: it requires up to {NUMBER} times the traction",
    "left out": r"^(?:contacts\.points\.)?(.+): no joint moves this point along the normal of",
    "jumps": r"^initial.equilibrium: .*the motion still jumps at the start",
    "unstable": rf"^controller.sample_time_s = {NUMBER} s: the sampled loop is unstable",
    "unpressed": r"^the motion is not unique: no load presses (.+), held by",
    "leaves in impact": (
        r"^the motion is not unique: impacts of other points or joint stops, .+?, lift (.+) off, although"
    ),
    "wedged": r"^the motion is not unique: friction alone can wedge (.+) without a load",
    "moved at the start": r"^initial.equilibrium: moves (.+) from the requested posture",
    "moves at once": rf"^initial.equilibrium: (\S+) nevertheless starts with {NUMBER} \S+.*",
    "slips at once": rf"^initial.equilibrium: the start slips at t = {NUMBER} s",
    "off target": rf"^(hand|head): (?:{NUMBER} mm \(limit .*\)|1) from its target at t = {NUMBER} s",
    "off path": rf"^hand: starts (?:{NUMBER} mm \(limit .*\)|1) from its path",
    "not carried out": rf"^operator: the hand did not execute {NUMBER} m of the commanded {NUMBER} m",
}
UNVERIFIED: dict[str, str] = {
    r"contact problems were abandoned": "the solver's count; forces and cones are checked",
    r"^contact rows were linearly dependent in": "the solver's count of evaluations",
    r"with friction, dependent contact rows also leave the motion undetermined": "a range over splits; the run has one",
    r"^time stepping: the power changes so fast": "a sum over all steps, of which samples show some",
    r"only braked joints move this point": "of brakes, which these scenes do not close",
    r"has no effect: ": "said of a key of the scenario, not of the run",
    r"^the target waited|^the path is|^feedback and shape points|^the null-space|^joints were clamped|^the robot tips|"
    r"^the support margin|^mode \d+ was|passes its limit by|"
    r"^the head is up to|^the controller's estimate": "for the kinematic snake, which these scenes do not have",
}
"""Warnings that nothing outside the engine can tell, each with the reason."""
# Sentences of the modules that make warnings which end as part of an error, of a stop, or of another sentence.
PARTS = (
    r"^joint .* moves no inertia in this posture",
    r"^plant: ",
    r"; until then, deviations could grow by a factor|; since t = 1 s deviations may have grown by a factor",
    r"^use .*, which is stable, or smaller gains",
    r"^the .* of .* starts |^the reference of .* starts|^the planned voltages rely on",
    r"^the motion does not determine|^in the samples",
    r"^; (?:while|when) .*, other solutions may move differently",
    r"^f_t = |^friction has added ",
    r"^, and contact forces differ from rest",
    r"^joint stops require",
    r"; reduce integrator.step_s to reduce the overshoot$|^it is still .* beyond its stop at the end$",
    r"^k_[pv] = ",
    r"^\S+ against \S+ for coefficients of",
    r"^the energy is known only to|^points sink up to|^the power changes so fast",
)

# Warnings that are not true of the plain arm of test_checks; no check knows the last one.
FALSE_WARNINGS = (
    "tip: never touches the floor and carries no load; smallest gap 3 mm at t = 0 s",
    "joint_1: voltage at its limit of 24 V for 50.0 % of the run",
    "joint_3: exceeds its lower position limit of 0° (0 rad) by up to 1° (0.02 rad), first at t = 0.1 s; no law",
    "the energy ledger does not close: residual 1.0e-03 of the turnover; tighten integrator.rtol or the step",
    "friction has added 0.3 J to the arm: an integration error; reduce integrator.step_s",
    "tip: chatter, more than 200 contact events within 1 s; lift-offs slower than 1e-03 m/s were suppressed",
    "bend: chatter, more than 200 events of its stop within 1 s; rebounds slower than 1e-03 rad/s were suppressed",
    "joint_1 9 of 2 A: the rms current of the run exceeds the nominal current; a real motor would overheat",
    "link_2 passes below floor by more than the link's radius: link_2 (radius 10 mm) by up to 90 mm in the samples",
    "operator: the hand did not execute 0.2 m of the commanded 0.4 m, mostly from t = 1 s on",
    "link_1-link_3: compressed by up to 5 mm, more than the rounding of the edges (2 mm); use a larger stiffness",
    "link_1-link_3: pass through each other at t = 0.1 s, because they move too fast (30 mm per step; half 2 mm)",
    "an unknown warning",
)
