"use strict";
// Panel of `dynsim pose`: sliders, gaps, torques and the scenario keys of the posture. DRIVE contains the address of the
// socket; `dynsim` is the page that shows the robot. Tests read `dynsim.pose`: last frame, number of frames.

const PERIOD_MS = 25, TOUCH_M = 1e-6, ROWS_NEAR = 5;
const RED = 0xc0202a;

class Pose {
  constructor() {
    Object.assign(this, { frames: 0, last: null, waiting: new Map(), over: "", rows: new Map(), points: new Map(), parts: {} });
    document.head.append(D.element("style", { textContent: DRIVE.style }));
    this.socket = new WebSocket(DRIVE.socket);
    this.socket.onmessage = (event) => this.receive(JSON.parse(event.data));
    this.socket.onclose = () => { this.over ||= "the connection is closed"; this.note.textContent = `${this.over}; the text below can still be copied`; };
    this.note = D.element("div", { className: "note" });
    this.note.setAttribute("role", "status");
    setInterval(() => this.flush(), PERIOD_MS);
  }

  receive(message) {
    if (message.hello) this.build(message.hello);
    else if (message.over !== undefined) this.over = message.over;
    else if (message.refused) this.note.textContent = message.refused;
    else this.show(message);
  }

  send(action, values = {}) {
    this.flush();
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ do: action, ...values }));
  }

  // Slider motions: the newest value of each slider is sent at most once per period.
  flush() {
    const waiting = [...this.waiting];
    this.waiting.clear();
    for (const [name, value] of waiting) this.send("set", { name, value });
  }

  button(text, title, act, name) {
    return D.element("button", { textContent: text, title, onclick: act, id: name ? `pose-${name}` : "" });
  }

  build(hello) {
    if (this.box) return;
    this.hello = hello;
    this.undo = this.button("undo", "undo the last change (Ctrl-Z)", () => this.send("undo"), "undo");
    this.redo = this.button("redo", "repeat the change that was undone (Ctrl-Y)", () => this.send("redo"), "redo");
    const reset = this.button("reset", "return to the start posture of the scenario", () => this.send("reset"), "reset");
    const check = this.button("check", "check the scenario with this posture, as `dynsim check` does", () => { this.note.textContent = "checking …"; this.send("check"); }, "check");
    this.rest = D.element("div", { className: "note" });
    this.box = D.element("div", { id: "pose" },
      D.element("h2", { textContent: "Posture" }, this.undo, this.redo, reset, check), this.note, this.sliders(hello.sliders),
      ...this.handParts(hello), ...this.contactParts(hello), ...this.nearParts(), this.rest, ...this.textParts());
    document.getElementById("side").append(this.box);
    // Keys of the page, such as g and space, must not act while a value is typed.
    this.box.addEventListener("keydown", (event) => event.stopPropagation());
    addEventListener("keydown", (event) => {
      const action = (event.ctrlKey || event.metaKey) && { z: "undo", y: "redo" }[event.key];
      if (!action || event.target.tagName === "TEXTAREA") return;
      event.preventDefault();
      this.send(action);
    }, true);
    // The trace of the hand would only show the order of the changes.
    dynsim.set("trace", false);
    dynsim.app.stage.resize();
  }

  sliders(list) {
    const table = D.element("table", {}, D.element("tr", {}, ...["joint", "", "", "", "torque", "limit"].map((text) => D.element("th", { textContent: text }))));
    for (const one of list) {
      const step = one.unit === "deg" ? 0.1 : 0.001, fixed = one.leader !== "";
      const range = D.element("input", { type: "range", min: one.low, max: one.high, step: "any", disabled: fixed });
      range.setAttribute("aria-label", one.name);
      const number = D.element("input", { type: "number", step, disabled: fixed });
      number.setAttribute("aria-label", `${one.name} [${one.unit}]`);
      range.dataset.name = number.dataset.name = one.name;
      range.oninput = () => { this.waiting.set(one.name, Number(range.value)); number.value = this.digits(Number(range.value), one.unit); };
      number.onchange = () => { if (number.value !== "" && Number.isFinite(Number(number.value))) this.send("set", { name: one.name, value: Number(number.value) }); };
      const title = fixed ? `follows ${one.leader}` : one.limits.some((x) => x !== null) ? `limits ${one.limits.map((x) => D.number(x)).join(" to ")} ${one.unit}` : "no limits";
      const name = D.element("td", { textContent: one.name, title: `${one.name}: ${title}` });
      const torque = D.element("td"), limit = D.element("td", { className: "off" });
      table.append(D.element("tr", { title }, name, D.element("td", { className: "wide" }, range), D.element("td", {}, number),
        D.element("td", { className: "off text", textContent: one.unit === "deg" ? "°" : "m" }), torque, limit));
      this.rows.set(one.name, { one, range, number, name, torque, limit });
    }
    return table;
  }

  handParts({ reaches }) {
    this.target = ["x", "y", "z"].map((axis) => D.element("input", { type: "number", step: 0.005, title: `${axis} of the hand [m]` }));
    this.target.forEach((input, k) => { input.dataset.name = `hand.${"xyz"[k]}`; input.oninput = () => { this.typed = true; }; });
    const tick = (text, title, checked) => { const box = D.element("input", { type: "checkbox", checked }); return [box, D.element("label", { title }, box, ` ${text}`)]; };
    const [braces, bracesLabel] = tick("braces", "contact points that touch stay on their surfaces", true);
    const [turn, turnLabel] = tick("orientation", "the hand does not turn", false);
    const move = this.button("move", "move the hand to this point by inverse kinematics", () => {
      const target = this.target.map((input) => Number(input.value));
      this.typed = false;
      this.send("reach", { target, braces: braces.checked, orientation: turn.checked });
    }, "move");
    for (const input of this.target) input.onkeydown = (event) => { if (event.key === "Enter") move.click(); };
    for (const input of this.target) input.disabled = !reaches;
    const row = D.element("div", { className: "row" }, ...this.target, D.element("span", { className: "off", textContent: "m" }), ...(reaches ? [move, " keep ", bracesLabel, turnLabel] : []));
    return [D.element("h2", { textContent: "Hand" }), row];
  }

  contactParts(hello) {
    this.contacts = D.element("table");
    const choice = (names, title) => D.element("select", { title }, ...names.map((name) => D.element("option", { value: name, textContent: name })));
    const body = choice(hello.bodies, "body that gets a contact point"), surface = choice(hello.surfaces, "surface that the point can touch");
    const add = this.button("add brace", "add the point of this body that is nearest to the surface as a contact point", () => this.send("brace", { body: body.value, surface: surface.value }), "brace");
    this.hand = D.element("input", { type: "checkbox" });
    const keep = D.element("label", { title: "the hand does not move while a point is put onto its surface" }, this.hand, " keep hand");
    const able = hello.bodies.length && hello.surfaces.length;
    this.margin = D.element("span", { className: "unit" });
    return [D.element("h2", { textContent: "Contact points" }, ...(able ? [keep] : []), this.margin), this.contacts,
      ...(able ? [D.element("div", { className: "row" }, body, " on ", surface, add)] : [])];
  }

  nearParts() {
    this.near = D.element("table");
    this.below = D.element("span", { className: "unit" });
    return [D.element("h2", { textContent: "Bodies near surfaces" }, this.below), this.near];
  }

  textParts() {
    this.text = D.element("textarea", { readOnly: true, spellcheck: false });
    this.text.setAttribute("aria-label", "keys of the scenario");
    this.choices = D.element("span", { className: "row" });
    this.copy = this.button("copy YAML", "copy the keys to the clipboard; merge them into the scenario", async () => {
      try { await navigator.clipboard.writeText(this.text.value); }
      catch { this.text.select(); document.execCommand("copy"); }
      this.copy.textContent = "copied";
      setTimeout(() => { this.copy.textContent = "copy YAML"; }, 1500);
    }, "copy");
    this.copy.className = "copy";
    return [D.element("h2", { textContent: "Keys of the scenario" }, this.copy, this.choices), this.text];
  }

  digits(value, unit) {
    return String(Number(value.toFixed(unit === "deg" ? 3 : 5)));
  }

  show(frame) {
    this.last = frame;
    const actor = dynsim.app.actors[0];
    this.place(actor, frame);
    dynsim.frame({ time: 0, poses: frame.poses, pressure: null, contacts: actor.contacts.map((c) => this.sample(frame, c.contact.name)) });
    this.redden(actor, frame);
    this.showTarget(actor, frame);
    for (const [name, row] of this.rows) this.showRow(row, frame.values[name], frame.torques[name], frame.units?.[name]);
    if (!this.typed && frame.hand) frame.hand.forEach((x, k) => { if (document.activeElement !== this.target[k]) this.target[k].value = Number(x.toFixed(5)); });
    this.note.textContent = frame.note;
    this.rest.textContent = frame.rest;
    this.undo.disabled = !frame.undo;
    this.redo.disabled = !frame.redo;
    this.margin.textContent = frame.margin === null || frame.margin === undefined ? "" : `tip margin of the base ${D.number(frame.margin, 3)}`;
    this.margin.classList.toggle("bad", frame.margin < 0);
    this.showContacts(frame);
    this.showNear(frame);
    this.showText(frame);
    this.frames++;
  }

  // Contact points of the scene; a point that is added on the page is created here, and hidden when that is undone.
  place(actor, frame) {
    for (const point of frame.points.filter((one) => !this.points.has(one.name))) {
      const group = new THREE.Group(), box = D.element("div");
      actor.inner.add(group);
      const contact = new M.Contact(group, point, actor.size);
      dynsim.app.tags.push({ actor, contact, box });
      document.getElementById("labels").append(box);
      const ball = new THREE.Mesh(new THREE.SphereGeometry(Math.max(point.radius, 1e-6), 20, 14), new THREE.MeshLambertMaterial({ transparent: true, opacity: 0.55 }));
      ball.position.set(...point.p);
      actor.bodies[point.body].object.add(ball);
      this.points.set(point.name, { contact, group, ball });
    }
    const names = new Set(frame.points.map((one) => one.name));
    for (const [name, { contact, group, ball }] of this.points) {
      group.visible = ball.visible = names.has(name);
      if (!names.has(name)) contact.state.shown = false;
    }
    actor.contacts = frame.points.map((one) => this.points.get(one.name).contact);
    actor.scale = Math.max(1e-6, ...frame.points.map((point) => Math.abs(point.force ?? 0)));
  }

  sample(frame, name) {
    const point = frame.points.find((one) => one.name === name);
    const touches = point.enabled && Math.abs(point.gap) <= TOUCH_M;
    const colours = dynsim.app.colours;
    this.points.get(name).ball.material.color.set(touches ? colours.stick : point.gap < -TOUCH_M ? RED : colours.open);
    return { force: touches && point.force !== null ? point.force : NaN, normal: point.normal, tangent: [0, 0, 0], mode: touches ? 2 : 0 };
  }

  // The hand path with the copied keys, which starts at the hand.
  showTarget(actor, frame) {
    const line = actor.paths.find((path) => path.kind === "target")?.line, key = String(frame.target);
    if (!line || !frame.target.length || key === this.shownTarget) return;
    this.shownTarget = key;
    line.geometry.dispose();
    line.geometry = new THREE.LineGeometry();
    line.geometry.setPositions(frame.target);
    line.computeLineDistances();
  }

  // Bodies below a surface are red in the scene.
  redden(actor, frame) {
    const below = new Set(frame.near.filter((one) => one.gap < one.least).map((one) => one.body));
    for (const body of actor.bodies)
      for (const part of body.paint) if (part.role !== "wheel") part.material.color.set(below.has(body.name) ? RED : part.base);
  }

  showRow(row, value, torque, unit) {
    const { one, range, number } = row;
    const [low, high] = [one.limits[0] ?? -Infinity, one.limits[1] ?? Infinity];
    const outside = value < low - 1e-6 || value > high + 1e-6, at = !outside && (value < low + 1e-6 || value > high - 1e-6);
    if (document.activeElement !== range || !this.waiting.has(one.name)) range.value = value;
    if (document.activeElement !== number) number.value = this.digits(value, one.unit);
    row.name.className = outside ? "bad" : at ? "edge" : one.leader ? "off" : "";
    row.name.textContent = at ? `${one.name} ⊣` : one.name;
    if (!torque) return;
    const [now, most, lasting] = torque, share = Math.abs(now) / (most ?? Infinity);
    row.torque.textContent = `${D.number(now, 3)} ${unit}`;
    row.torque.className = share > 1 || Math.abs(now) > (lasting ?? Infinity) ? "bad" : "";
    const least = Math.min(most ?? Infinity, lasting ?? Infinity);
    row.limit.textContent = Number.isFinite(least) ? `${D.number(least, 3)}` : "–";
    row.limit.title = `largest torque at rest ${most === null ? "unknown" : D.number(most, 4)} ${unit}, continuous rating ${lasting === null ? "unknown" : D.number(lasting, 4)} ${unit}`;
  }

  showContacts(frame) {
    if (!frame.points.length) { this.contacts.replaceChildren(D.element("tr", {}, D.element("td", { className: "off", textContent: "none in this scenario" }))); return; }
    const head = ["point", "surface", "at x, y, z [m]", "gap [mm]", "force", ""].map((text) => D.element("th", { textContent: text }));
    this.contacts.replaceChildren(D.element("tr", {}, ...head), ...frame.points.map((point) => {
      const touches = Math.abs(point.gap) <= TOUCH_M, wrong = point.gap < -TOUCH_M || (frame.bilateral && point.enabled && !touches);
      const gap = D.element("td", { className: touches ? "touch" : wrong ? "bad" : "", textContent: touches ? "touches" : (1e3 * point.gap).toFixed(2) });
      if (frame.bilateral && wrong) gap.title = "contacts.law: bilateral requires that every enabled point starts on its surface";
      const snap = this.button("snap", "put this point onto its surface; points that touch stay there", () => this.send("snap", { name: point.name, hand: this.hand.checked }), `snap-${point.name}`);
      snap.disabled = touches || !point.snaps;
      return D.element("tr", { className: point.enabled ? "" : "off", title: point.enabled ? "" : "disabled in this variant" },
        D.element("td", { textContent: point.name, title: point.name }), D.element("td", { className: "text", textContent: point.surface }),
        D.element("td", { textContent: point.at.map((x) => x.toFixed(3)).join(", ") }), gap,
        D.element("td", { textContent: point.force === null || !touches ? "" : `${D.number(point.force, 3)} N` }), D.element("td", {}, snap));
    }));
  }

  showNear(frame) {
    const below = frame.near.filter((one) => one.gap < one.least);
    this.below.textContent = below.length ? `${below.length} below a surface` : frame.near.length ? "axis of the body to the surface" : "no surfaces in this scenario";
    this.below.classList.toggle("bad", below.length > 0);
    const rows = frame.near.slice(0, Math.max(ROWS_NEAR, Math.min(below.length, 12)));
    this.near.replaceChildren(...rows.map((one) => D.element("tr", {}, D.element("td", { textContent: one.body }), D.element("td", { className: "text", textContent: one.surface }),
      D.element("td", { className: one.gap < one.least ? "bad wide" : "wide", textContent: `${(1e3 * one.gap).toFixed(1)} mm` }))));
  }

  showText(frame) {
    const names = Object.keys(frame.text);
    if (names.join() !== this.names) {
      this.names = names.join();
      this.choices.replaceChildren(...names.map((name) => {
        const box = D.element("input", { type: "checkbox", checked: this.parts[name] ?? true });
        box.dataset.name = name;
        box.onchange = () => { this.parts[name] = box.checked; this.showText(this.last); };
        return D.element("label", {}, box, ` ${name}`);
      }));
    }
    const text = names.filter((name) => this.parts[name] ?? true).map((name) => frame.text[name]).join("");
    if (this.text.value !== text) this.text.value = text;
  }
}

dynsim.ready.then(() => { dynsim.pose = new Pose(); });
