"use strict";
// Pilot side of a live drive. DRIVE contains the address of the socket; `dynsim` is the page that shows the robot.
// Tests read `dynsim.drive`: role, state, last command, round trip, number of frames.

const PERIOD_MS = 20, DEAD_ZONE = 0.12;
// If messages are later than this [ms], drawing takes too long: then the resolution and the frame rate are reduced,
// because a busy page does not notice that a key is released. The allowed silence is not extended.
const BUSY_MS = 60, LEAST_RATIO = 0.35;
// Keys by the name of an axis: forward and back.
const AXIS_KEYS = {
  x: ["KeyW", "KeyS"], y: ["KeyA", "KeyD"], z: ["KeyR", "KeyF"],
  alpha: ["KeyO", "KeyU"], beta: ["KeyK", "KeyI"], gamma: ["KeyJ", "KeyL"],
  ahead: ["ArrowUp", "ArrowDown"], turn: ["ArrowLeft", "ArrowRight"],
};
// Control for each axis on a gamepad with the standard layout: {axis, sign}, or {forward, back} for two buttons.
const PAD_ARM = { x: { axis: 1, sign: -1 }, y: { axis: 0, sign: -1 }, z: { axis: 3, sign: -1 }, gamma: { axis: 2, sign: -1 },
  beta: { forward: 13, back: 12 }, alpha: { forward: 15, back: 14 } };
const PAD_BASE = { ahead: { axis: 1, sign: -1 }, turn: { axis: 0, sign: -1 }, x: { axis: 3, sign: -1 }, y: { axis: 2, sign: -1 },
  z: { forward: 7, back: 6 } };
const PAD_HOLD = [4, 5], PAD_GRIP = 0;

// Axes of the sticks, across and up; each axis belongs to one stick.
const STICKS = [["turn", "ahead"], ["y", "x"], ["gamma", "z"], ["alpha", "beta"]];
const TOUCH = matchMedia("(hover: none)");

// An open contact, which is not drawn.
const NOTHING = { force: NaN, normal: [0, 0, 1], tangent: [0, 0, 0], mode: 0, hidden: true };

class Drive {
  constructor() {
    this.keys = new Set();
    this.sticks = new Map();
    Object.assign(this, { role: "watching", free: true, state: "connecting", count: 0, frames: 0, roundTrip: NaN, closed: false, scale: 1,
      request: null, slow: 0, drawnAt: 0, reducedAt: 0, ratio: 1, sent: new Map(), newest: null, ended: false, over: "", refused: [], command: null, grip: false });
    document.head.append(D.element("style", { textContent: DRIVE.style }));
    this.socket = new WebSocket(DRIVE.socket);
    this.socket.onmessage = (event) => this.receive(JSON.parse(event.data));
    this.socket.onclose = () => { this.ended = true; this.showStatus(); };
  }

  receive(message) {
    if (message.hello) { this.begin(message.hello); return; }
    if (message.role) { this.role = message.role; this.free = message.free; this.showStatus(); return; }
    if (message.over !== undefined) { this.over = message.over; return; }
    if (message.refused) { this.refused.push(message.refused); console.warn(message.refused); return; }
    this.newest = message;
    const at = this.sent.get(message.n);
    if (at !== undefined) {
      const trip = performance.now() - at;
      this.roundTrip = Number.isNaN(this.roundTrip) ? trip : 0.9 * this.roundTrip + 0.1 * trip;
      for (const n of this.sent.keys()) if (n <= message.n) this.sent.delete(n);
    }
  }

  begin(hello) {
    this.axes = hello.axes;
    this.modes = hello.modes;
    this.names = hello.axes.map((axis) => axis.name);
    this.pad = this.names.includes("ahead") ? PAD_BASE : PAD_ARM;
    this.build(hello);
    this.listen();
    this.transmit({ do: "take" });
    setInterval(() => this.beat(), PERIOD_MS);
    const draw = () => { this.draw(); requestAnimationFrame(draw); };
    requestAnimationFrame(draw);
  }

  transmit(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  // Sends a command 50 times per second: each device contributes while its own dead-man switch is held.
  beat() {
    const now = performance.now(), gap = now - (this.beatAt ?? now);
    this.beatAt = now;
    this.slow = Math.max(0.97 * this.slow, gap);
    if (this.role !== "pilot") return;
    const axes = this.names.map(() => 0), add = (values) => values.forEach((v, k) => { axes[k] += v; });
    let held = false;
    const away = document.hidden || !document.hasFocus();
    if (!away && (this.keys.has("Space") || this.button)) held = true, add(this.fromKeys());
    if (!away && [...this.sticks.values()].some((s) => s.held)) held = true, add(this.fromSticks());
    const pad = away ? null : this.fromPad();
    if (pad) held = true, add(pad);
    this.send(axes.map((v) => this.scale * Math.min(Math.max(v, -1), 1)), held);
  }

  send(axes, held) {
    const message = { n: ++this.count, axes, held, closed: this.closed };
    if (this.request !== null && held) { message.mode = this.request; this.request = null; }
    if (held && !this.command?.held) this.heldFrom = this.count;
    this.sent.set(this.count, performance.now());
    if (this.sent.size > 200) this.sent.delete(this.sent.keys().next().value);
    this.command = message;
    this.transmit(message);
  }

  // If the focus is lost, the tab is hidden or the page is left, releases everything at once instead of after the silence.
  releaseAll() {
    this.keys.clear();
    this.button = false;
    for (const stick of this.sticks.values()) stick.release();
    this.request = null;
    if (this.role === "pilot" && this.names) this.send(this.names.map(() => 0), false);
  }

  fromKeys() {
    return this.names.map((name) => {
      const [forward, back] = AXIS_KEYS[name];
      return Number(this.keys.has(forward)) - Number(this.keys.has(back));
    });
  }

  fromSticks() {
    return this.names.map((name) => [...this.sticks.values()].reduce((sum, s) => sum + (s.held ? s.values[name] ?? 0 : 0), 0));
  }

  fromPad() {
    const pad = [...(navigator.getGamepads?.() ?? [])].find((p) => p && p.connected);
    if (!pad) return null;
    const pressed = (k) => Boolean(pad.buttons[k]?.pressed), value = (k) => pad.buttons[k]?.value ?? 0;
    const grip = pressed(PAD_GRIP);
    const held = PAD_HOLD.some(pressed);
    if (grip && !this.grip && held && this.gripper) this.toggleGripper();
    this.grip = grip;
    if (!held) return null;
    return this.names.map((name) => {
      const where = this.pad[name];
      if (!where) return 0;
      if (where.axis === undefined) return value(where.forward) - value(where.back);
      const x = pad.axes[where.axis] ?? 0;
      return Math.abs(x) < DEAD_ZONE ? 0 : where.sign * Math.sign(x) * (Math.abs(x) - DEAD_ZONE) / (1 - DEAD_ZONE);
    });
  }

  listen() {
    const known = new Set(["Space", ...this.names.flatMap((name) => AXIS_KEYS[name])]);
    const actions = { KeyG: () => this.gripper && this.toggleGripper(), KeyM: () => this.ask("switching"), KeyN: () => this.ask("fixing") };
    // Capture these keys before the page, which uses some of them.
    window.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
      const act = this.role === "pilot" && (known.has(event.code) || (actions[event.code] && (event.code !== "KeyG" || this.gripper)));
      if (!act && !known.has(event.code)) return;
      event.preventDefault();
      event.stopImmediatePropagation();
      if (known.has(event.code)) this.keys.add(event.code);
      else if (!event.repeat) actions[event.code]();
    }, true);
    window.addEventListener("keyup", (event) => this.keys.delete(event.code), true);
    window.addEventListener("blur", () => this.releaseAll());
    window.addEventListener("pagehide", () => this.releaseAll());
    document.addEventListener("visibilitychange", () => { if (document.hidden) this.releaseAll(); });
  }

  toggleGripper() {
    this.closed = !this.closed;
    this.showStatus();
  }

  // Requests a mode in the next command with the dead-man switch held.
  ask(mode) {
    if (this.modes.length) this.request = mode;
  }

  build(hello) {
    const button = (text, title, act) => D.element("button", { textContent: text, title, onclick: act });
    this.gripper = hello.gripper;
    this.box = D.element("div", { id: "drive" });
    this.stateBox = D.element("span", { className: "state" });
    this.timing = D.element("span", { className: "timing" });
    this.lateBox = D.element("span", { className: "late" });
    this.roleButton = button("", "", () => this.transmit({ do: this.role === "pilot" ? "leave" : "take" }));
    this.roleButton.id = "role";
    const hold = button("hold to drive", "dead-man switch, like the space bar; hold it together with the keys of the axes");
    hold.id = "hold";
    hold.onpointerdown = (event) => { hold.setPointerCapture(event.pointerId); this.button = true; };
    hold.onpointerup = hold.onpointercancel = hold.onlostpointercapture = () => { this.button = false; };
    const speed = D.element("input", { type: "range", min: "0.1", max: "1", step: "0.1", value: "1", title: "fraction of full speed", id: "part" });
    speed.oninput = () => { this.scale = Number(speed.value); };
    this.grips = button("", "gripper (g)", () => this.toggleGripper());
    const modes = hello.modes.length ? D.element("select", { id: "mode", title: "mode to request while the dead-man switch is held" },
      ...["mode …", "switching", "fixing", ...hello.modes].map((m) => D.element("option", { value: m, textContent: m }))) : null;
    if (modes) modes.onchange = () => {
      if (modes.selectedIndex > 0) this.ask(modes.selectedIndex < 3 ? modes.value : Number(modes.value));
      modes.selectedIndex = 0;
      modes.blur();
    };
    const end = button("end the drive", "end and save the drive", () => { if (this.role === "pilot") this.transmit({ do: "end" }); });
    end.id = "end";
    const actions = D.element("span", { className: "actions" }, hold, D.element("label", {}, " speed ", speed), ...(hello.gripper ? [this.grips] : []), ...(modes ? [modes] : []), end);
    const keys = D.element("dl", {}, ...this.axes.map((axis) => D.element("span", { title: `${axis.group} ${axis.name}, up to ${axis.limit} ${axis.unit}` },
      ...AXIS_KEYS[axis.name].map((key) => D.element("kbd", { textContent: label(key) })), ` ${axis.group} ${axis.name}`)),
      ...(hello.gripper ? [D.element("span", { title: "close or open the gripper" }, D.element("kbd", { textContent: "G" }), " gripper")] : []),
      ...(hello.modes.length ? [D.element("span", { title: "modes to request while the dead-man switch is held" }, D.element("kbd", { textContent: "M" }), D.element("kbd", { textContent: "N" }), " switching, fixing")] : []));
    const sticks = D.element("div", { className: "sticks" });
    for (const pair of STICKS) {
      const [across, up] = pair.map((name) => (this.names.includes(name) ? name : null));
      if (!across && !up) continue;
      const stick = new Stick(across, up);
      this.sticks.set(up ?? across, stick);
      sticks.append(stick.box);
    }
    this.bar = D.element("div", { className: "bar" }, this.stateBox, this.roleButton, actions, this.timing, this.lateBox, keys);
    this.box.append(sticks, this.bar);
    document.querySelector("main").append(this.box);
    // The camera follows a robot that can move away.
    dynsim.set("follow", ["ahead", "gamma"].some((name) => this.names.includes(name)));
    this.showStatus();
  }

  draw() {
    const frame = this.newest, now = performance.now();
    if (!frame || (this.slow > BUSY_MS && now - this.drawnAt < 2 * this.slow)) return;
    this.reduceDetail(now);
    this.drawnAt = now;
    this.newest = null;
    this.frames++;
    // Arrows are scaled to the largest forces so far; a single impact counts little.
    const actor = dynsim.app.actors[0], most = Math.max(0, ...Object.values(frame.contacts).map((c) => Math.abs(c.force)));
    actor.scale += 0.1 * Math.max(most - actor.scale, 0);
    dynsim.frame({ time: frame.time, poses: frame.poses, pressure: null, ...(frame.wheels ? { wheels: frame.wheels } : {}),
      contacts: actor.contacts.map((c) => frame.contacts[c.contact.name] ?? NOTHING), ...(frame.gripper === undefined ? {} : { gripper: frame.gripper }) });
    this.last = frame;
    this.state = frame.state;
    this.showStatus();
  }

  reduceDetail(now) {
    if (this.slow < BUSY_MS || this.ratio <= LEAST_RATIO || now - this.reducedAt < 1000) return;
    this.reducedAt = now;
    this.ratio *= 0.7;
    const stage = dynsim.app.stage;
    stage.shadows(false);
    stage.renderer.setPixelRatio(this.ratio);
    stage.renderer.setSize(...stage.size, false);
    stage.touch();
  }

  // Returns the class of the style sheet and the text of the present state.
  status() {
    if (this.ended) return ["over", `the drive is over: ${this.over || "connection closed"}`];
    if (this.state === "driving") return this.last?.hindrance ? ["hindered", `driving, limited: ${this.last.hindrance}`] : ["driving", "driving"];
    // Only the pilot sees instructions.
    if (this.state === "silent" && this.role !== "pilot") return ["silent", "the pilot is silent"];
    if (this.state === "silent") return ["silent", "silent: the connection or the page paused; release the key, then hold it again"];
    if (this.state === "the robot is not ready yet") return ["silent", this.state];
    // The server has received the key but ignores it: it was held before the robot was ready, or by a new pilot.
    if (this.role === "pilot" && this.command?.held && this.last?.n >= this.heldFrom && this.state === "key released") return ["silent", "release the key, then hold it again"];
    return ["", this.role === "pilot" && this.state === "key released" ? `hold ${TOUCH.matches ? "a stick" : "space"} to drive` : this.state];
  }

  showStatus() {
    if (!this.box) return;
    const f = this.last, [kind, text] = this.status();
    this.box.classList.toggle("ended", this.ended);
    this.bar.classList.toggle("watching", this.role !== "pilot");
    this.box.classList.toggle("watching", this.role !== "pilot");
    this.stateBox.textContent = text;
    this.stateBox.className = `state ${kind}`;
    this.roleButton.textContent = this.role === "pilot" ? "release control" : this.free ? "take control" : "another pilot drives";
    this.roleButton.disabled = this.ended || (this.role !== "pilot" && !this.free);
    this.grips.textContent = this.closed ? "open gripper" : "close gripper";
    if (!f) return;
    this.timing.textContent = `${f.time.toFixed(1)} s` + (f.mode === undefined ? "" : ` · mode ${f.mode}`) + (f.grip ? ` · gripper ${f.grip}` : "")
      + (Number.isNaN(this.roundTrip) || this.role !== "pilot" ? "" : ` · round trip ${this.roundTrip.toFixed(0)} ms`);
    this.lateBox.textContent = f.lost > 0.1 || f.late > 50 ? `late ${f.late.toFixed(0)} ms · ${f.lost.toFixed(1)} s behind real time` : "";
  }
}

// A stick on a touch screen; the finger is its dead-man switch.
class Stick {
  constructor(across, up) {
    this.held = false;
    this.values = {};
    this.across = across;
    this.up = up;
    this.knob = D.element("i");
    this.box = D.element("div", { className: "stick" }, this.knob, D.element("span", { textContent: [up, across].filter(Boolean).join(", ") }));
    this.box.dataset.name = up ?? across;
    this.box.onpointerdown = (event) => { this.box.setPointerCapture(event.pointerId); this.held = true; this.move(event); };
    this.box.onpointermove = (event) => { if (this.held) this.move(event); };
    this.box.onpointerup = this.box.onpointercancel = this.box.onlostpointercapture = () => this.release();
  }

  move(event) {
    const area = this.box.getBoundingClientRect();
    const reach = area.width / 3;
    let x = (event.clientX - area.left - area.width / 2) / reach, y = (event.clientY - area.top - area.height / 2) / reach;
    const r = Math.max(Math.hypot(x, y), 1);
    x /= r;
    y /= r;
    this.knob.style.transform = `translate(${reach * x}px, ${reach * y}px)`;
    this.values = {};
    if (this.across) this.values[this.across] = -x;
    if (this.up) this.values[this.up] = -y;
  }

  release() {
    this.held = false;
    this.values = {};
    this.knob.style.transform = "";
  }
}

function label(code) {
  return { ArrowUp: "↑", ArrowDown: "↓", ArrowLeft: "←", ArrowRight: "→" }[code] ?? code.replace("Key", "");
}

dynsim.ready.then(() => { dynsim.drive = new Drive(); });
