"""Brakes of a stepped simulation: braked joints have a very large armature, contacts they block are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dynsim.compile.mobility import immobile, mobility_floors
from dynsim.compile.touching import gap_at
from dynsim.dynamics import tables as ka
from dynsim.dynamics.contact.rows import row_errors, set_modes
from dynsim.dynamics.derivative import derivative
from dynsim.dynamics.state import block
from dynsim.engine.prepare import Prepared
from dynsim.integrators.run import project_level
from dynsim.jit.kernel import integers
from dynsim.scenario import Scenario, build


def projection_loss(prepared: Prepared, time: float) -> float:
    """Project joint rates onto the constraints of the bilateral law and return the kinetic energy lost [J].

    Steps also project rates, to remove their integration errors. The ledger must show the loss at a brake separately.
    """
    system, workspace, y = prepared.system, prepared.workspace, prepared.run.y
    if workspace.counts[ka.ROWS] == 0:
        return 0.0
    derivative(system, time, y, workspace, np.zeros_like(y))
    row_errors(workspace)
    return float(project_level(system, workspace, y, 1))


class Brakes:
    """State of joints and contacts without brakes, and the contacts left out behind brakes.

    Attributes
    ----------
    armature : (n,) ndarray
        Armature of the joints without brakes [kg m² or kg].
    """

    def __init__(self, scenario: Scenario, prepared: Prepared) -> None:
        self.armature = prepared.model.armature
        self._scenario = scenario
        self._floors = prepared.system.contacts.law[:, ka.FLOOR].copy()

    def leave_contacts_out(self, prepared: Prepared, time: float) -> tuple[Prepared, list[str]]:
        """Leave out contacts that only braked joints would move along their normals, and restore the other contacts.

        The force of such a contact could be any share of the load on the brakes. Call this whenever brakes have closed
        or opened.

        Parameters
        ----------
        prepared : Prepared
            Prepared run.
        time : float
            Present time [s].

        Returns
        -------
        Prepared
            Run with updated contacts.
        list of str
            A warning for each contact on its surface that is left out for the first time.
        """
        model, contacts, workspace = prepared.model, prepared.contacts, prepared.workspace
        table, law = prepared.system.contacts.link, prepared.system.contacts.law
        braked = set(np.flatnonzero(model.arrays.body[:, ka.ARMATURE] == ka.BRAKED).tolist())
        q = prepared.run.y[block(prepared.run.layout, "q")]
        before = table[:, ka.LEFT_OUT].copy()
        still = immobile(model, contacts, braked, q) if braked else [False] * len(contacts)
        table[:, ka.LEFT_OUT] = [contact.left_out or now for contact, now in zip(contacts, still, strict=True)]
        if prepared.system.unilateral is None and contacts:
            law[:, ka.FLOOR] = mobility_floors(model, contacts, braked, q) if braked else self._floors
            if (table[:, ka.LEFT_OUT] != before).any():
                modes = np.where(table[:, ka.LEFT_OUT] == 1, ka.OPEN, ka.SLIDING)
                set_modes(prepared.system.contacts, prepared.system.couplings, None, workspace, integers(modes))
            first = workspace.active[: len(contacts), ka.FIRST_ROW]
            workspace.rows[first, ka.ROW_FLOOR] = law[:, ka.FLOOR]
        known, since = prepared.behind_brakes, dict[str, float]()
        for k in np.flatnonzero(table[:, ka.LEFT_OUT] > before):
            if contacts[k].name not in known and gap_at(model, contacts[k], q) <= build.START_TOLERANCE:
                since[contacts[k].name] = time
        sentences = build.left_out_warnings(self._scenario, [c for c in contacts if c.name in since], since)
        return replace(prepared, behind_brakes={**known, **since}), sentences
