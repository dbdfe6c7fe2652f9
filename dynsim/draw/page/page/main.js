"use strict";
// Player: entry point of the page. `dynsim` is the interface for tests, films and live driving:
//   dynsim.ready           promise that resolves when the page is ready
//   dynsim.seek(t)         show and draw a time [s]
//   dynsim.state()         displayed state: time, poses of all bodies, arrows, wheels, support
//   dynsim.frame(f, k)     show an external frame with robot k:
//                          {time, poses: [x, y, z, qw, qx, qy, qz of each body], contacts, wheels, pressure, gripper}
//   dynsim.set(name, value) (playing, speed, theme, ghost, follow, colouring, or a layer), dynsim.camera(name), dynsim.image() (PNG as a data URL), dynsim.cost (ms of the last update)

// Maximum number of labelled variants; as many are shown at first.
const LABELLED = 4;
// Maximum number of contacts whose friction cones are shown at first.
const CONES = 12;
// Thickness of walls relative to the reach of the robot.
const THICK = 0.03;
// Whether a surface is a horizontal plane with its free side above.
const flat = (s) => s.kind === "plane" && Math.abs(s.q[1]) < 1e-6 && Math.abs(s.q[2]) < 1e-6;

class App {
  constructor({ head, bytes }) {
    this.head = head;
    const meshes = head.meshes.map((mesh) => S.mesh(bytes, mesh));
    this.actors = head.records.map((record, k) => new Actor(record, bytes, meshes, k));
    this.span = [Math.min(...this.actors.map((a) => a.span[0])), Math.max(...this.actors.map((a) => a.span[1]))];
    // A measured record may begin before the simulated one: start when all records have begun.
    const begun = Math.max(...this.actors.map((a) => a.span[0]));
    this.start = begun < this.span[1] ? begun : this.span[0];
    this.stage = new Stage(document.getElementById("scene"), head.azimuth, (camera) => {
      for (const actor of this.actors) for (const one of actor.surfaces) S.face(one, camera);
    });
    this.layers = { forces: true, cones: true, trace: true, target: true, support: true, depths: true, labels: true };
    Object.assign(this, { time: this.start, playing: false, speed: 1, follow: false, ghost: head.ghost, colouring: "", live: false, cost: 0 });
    this.theme = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
    this.point = new THREE.Vector3();
    this.surfaces();
    // With many variants, only the first ones are shown and labelled; the others can be chosen.
    this.labelled = [];
    for (const [k, actor] of this.actors.entries()) {
      this.stage.scene.add(actor.object);
      actor.object.visible = false;
      if (k < LABELLED) this.admit(actor);
    }
    this.names = this.actors.map((actor) => ({ actor, box: D.element("div", { className: "name", textContent: actor.name }) }));
    this.tags = this.actors.flatMap((actor) => actor.contacts.map((contact) => ({ actor, contact, box: D.element("div") })));
    this.deep = this.actors.flatMap((actor) => actor.sunk.map((one) => ({ actor, one, box: D.element("div") })));
    document.getElementById("labels").append(...[...this.names, ...this.tags, ...this.deep].map((tag) => tag.box));
    // Many friction cones would hide the robots.
    this.layers.cones = this.labelled.reduce((sum, a) => sum + a.contacts.length, 0) <= CONES;
    this.table = new ContactTable(document.getElementById("contacts"), this);
    this.plots = new Plots(document.getElementById("plots"), this.actors, { seek: (t) => this.seek(t), span: () => this.span,
      colour: (actor) => this.colourOf(actor), palette: () => D.variants[this.theme] });
    document.getElementById("add-plot").onclick = () => this.plots.add(this.plots.names.find((n) => !this.plots.plots.some((p) => p.signal === n)));
    this.sync = wire(this);
    hovering(this, this.stage.canvas, document.getElementById("hover"));
    document.getElementById("title").textContent = this.actors.length > 1 ? document.title : this.actors[0].data.title;
    document.getElementById("notes").append(...[...head.notes, `written by ${head.by}`].map((n) => D.element("div", { textContent: n })));
    this.arrange();
    this.dress();
    for (const name of this.firstPlots()) this.plots.add(name);
    this.stage.resize();
    this.show();
    const tick = (now) => { this.tick(now); requestAnimationFrame(tick); };
    requestAnimationFrame(tick);
  }

  firstPlots() {
    const wanted = this.actors.length > 1 ? ["contact_normal_force", "tip_margin", "energy_electrical_drawn", "hand_error", "position_error", "support_margin"]
      : ["contact_normal_force", "wheel_load", "hand_error", "support_margin", "position_error", "power", "q", "phi"];
    return wanted.filter((name) => this.actors.some((a) => a.signals.get(name))).slice(0, 3);
  }

  // Surfaces: the floor belongs to the stage, others to each robot.
  surfaces() {
    // A floor is common to all variants; without it, a faint grid below everything helps to judge positions.
    const floors = this.actors.map((a) => a.data.surfaces.filter(flat).map((s) => s.p[2])), low = this.head.box[0][2];
    const common = floors[0].find((z) => floors.every((others) => others.some((other) => Math.abs(other - z) < 1e-6)));
    const bare = this.actors.every((a) => !a.data.surfaces.length && !a.data.fixed.length);
    this.stage.real = common !== undefined || this.actors.every((a) => !a.data.surfaces.length);
    const depths = this.actors.flatMap((a) => a.data.surfaces.map((s) => this.depth(s, a))).filter((z) => z > low - 2 * this.actors[0].data.reach);
    this.floor = common ?? (bare ? low : Math.min(0, low, ...depths));
    for (const actor of this.actors) {
      actor.surfaces = [];
      for (const surface of actor.data.surfaces) {
        if (flat(surface) && Math.abs(surface.p[2] - this.floor) < 1e-6) continue;
        const made = S.surface(surface, THICK * actor.data.reach, this.floor);
        made.receiveShadow = true;
        made.userData = { surface, normal: new THREE.Vector3(0, 0, 1).applyQuaternion(made.quaternion), rest: made.position.clone() };
        actor.surfaces.push(made);
        actor.object.add(made);
      }
      if (actor.surfaces.length) actor.seenBehind();
      actor.stand(this.floor);
    }
  }

  // Lowest height of a surface.
  depth(surface, actor) {
    if (surface.kind === "plane") return surface.p[2] - (flat(surface) ? THICK * actor.data.reach : 0);
    const made = { userData: { surface }, position: new THREE.Vector3(...(surface.p ?? [0, 0, 0])), quaternion: new THREE.Quaternion(...S.xyzw(surface.q ?? [1, 0, 0, 0])) };
    return S.extent(made, M.z)[0] ?? Infinity;
  }

  // Variants side by side, or overlaid.
  arrange() {
    const [low, high] = this.head.box.map((corner) => new THREE.Vector3(...corner));
    const shown = this.actors.filter((a) => a.object.visible), first = shown[0];
    const { along, across, apart, beside, count } = this.ghost ? { along: "y", across: "x", apart: 0, beside: 0, count: shown.length }
      : this.spacing(shown, low, high);
    this.stage.rows = shown.length > count;
    shown.forEach((actor, k) => {
      actor.object.position.set(0, 0, 0)[along] = (k % count) * apart;
      actor.object.position[across] = Math.floor(k / count) * beside;
      this.stage.turned(actor.object.position);
      for (const one of actor.surfaces) {
        one.visible = actor === first || !this.shared(one, first, actor.object.position);
        one.scale.set(1, 1, 1);
        one.position.copy(one.userData.rest);
      }
    });
    // A wall of the first variant extends past the variants that share it.
    for (const [k, one] of (first?.surfaces ?? []).entries())
      if (one.userData.surface.kind === "plane") this.extend(one, shown.filter((a) => a !== first && a.surfaces[k]?.visible === false));
    high[along] += apart * Math.max(Math.min(shown.length, count) - 1, 0);
    high[across] += beside * (Math.ceil(shown.length / count) - 1);
    this.stage.row = along === "x" && shown.length > 1;
    this.stage.settle(low, high, this.floor);
    this.stage.dress(D.palette[this.theme]);
  }

  // Direction and distance of variants side by side: one behind the other for the viewer, but across a long surface such
  // as a pipe or a beam, on which the next variant would otherwise stand too.
  spacing(shown, low, high) {
    const ways = ["y", "x"].map((along) => {
      const way = this.stage.turned(new THREE.Vector3(along === "x" ? 1 : 0, along === "y" ? 1 : 0, 0));
      const span = high[along] - low[along], ends = shown.flatMap((a) => a.surfaces.flatMap((one) => S.extent(one, way)));
      return { along, span, apart: Math.max(span, Math.max(high[along], ...ends) - Math.min(low[along], ...ends)) };
    });
    const [y, x] = ways, best = x.apart / x.span < 0.7 * (y.apart / y.span) ? x : y, other = best === x ? y : x;
    // A ground that is larger than everything in both directions cannot be avoided.
    const room = (way) => (way.apart > 3 * way.span ? way.span : way.apart) + 0.06 * Math.max(x.span, y.span);
    // Several rows leave space for names.
    const apart = room(best), n = shown.length, beside = (n > 6 ? 1.35 : 1) * room(other);
    // Many variants are in several rows that fill the window.
    const extent = (m) => Math.max(m * apart * (best === x ? 0.7 : 1), Math.ceil(n / m) * beside * (best === x ? 1 : 0.7));
    const counts = n > 6 ? [...Array(n).keys()].map((k) => k + 1) : [n];
    const count = counts.reduce((m, k) => (extent(k) < extent(m) ? k : m), counts[0]);
    return { along: best.along, across: other.along, apart, beside, count };
  }

  // Extend a wall so that it passes all these variants.
  extend(wall, actors) {
    const axes = [0, 1].map((k) => new THREE.Vector3().setComponent(k, 1).applyQuaternion(wall.quaternion));
    for (const [k, axis] of axes.entries()) {
      const ends = [0, ...actors.map((a) => a.object.position.dot(axis))], low = Math.min(...ends), high = Math.max(...ends);
      const size = wall.userData.surface.size[k];
      wall.scale.setComponent(k, (size + high - low) / size);
      wall.position.addScaledVector(axis, 0.5 * (low + high));
    }
  }

  // Whether a surface coincides with the same surface of the first variant: walls continue, and overlays share all surfaces.
  shared(one, first, offset) {
    const { surface, normal } = one.userData, same = JSON.stringify(surface);
    const has = (actor) => actor.surfaces.some((other) => JSON.stringify(other.userData.surface) === same);
    if (!has(first)) return false;
    return this.ghost || (!this.stage.rows && this.actors.every((a) => !a.object.visible || has(a)) && surface.kind === "plane" && Math.abs(normal.dot(offset)) < 1e-6 * offset.length());
  }

  dress() {
    document.documentElement.dataset.theme = this.theme;
    const colours = D.palette[this.theme];
    this.colours = colours;
    const first = this.actors.find((a) => a.object.visible);
    for (const actor of this.actors) {
      const own = this.actors.length > 1 ? this.colourOf(actor) : null;
      actor.dress(colours, own ?? colours.hub, own ?? colours.hand, this.ghost && actor !== first);
      actor.plain = new THREE.Color(colours.body);
      for (const one of actor.surfaces) S.paint(one, colours);
    }
    this.stage.dress(colours);
    this.plots.redraw();
    this.sync();
    this.show();
  }

  colourOf(actor) {
    return D.variants[this.theme][actor.slot ?? actor.index % 7];
  }

  // Show a variant in a free colour, with labels if fewer than the maximum have some.
  admit(actor) {
    const taken = this.actors.filter((a) => a.object.visible).map((a) => a.slot), own = actor.index % 7;
    actor.slot = taken.includes(own) ? [0, 1, 2, 3, 4, 5, 6].find((k) => !taken.includes(k)) ?? own : own;
    actor.object.visible = true;
    if (this.labelled.length < LABELLED) this.labelled.push(actor);
  }

  // Label a variant; the one that has been labelled longest makes room.
  mark(actor, on) {
    this.labelled = this.labelled.filter((a) => a !== actor);
    if (on && !actor.object.visible) this.toggle(actor);
    if (on && !this.labelled.includes(actor)) this.labelled = [...this.labelled.slice(-LABELLED + 1), actor];
    this.sync();
    this.show();
  }

  has(layer) {
    const some = (test) => this.actors.some(test);
    return { forces: some((a) => a.contacts.length), cones: some((a) => a.data.contacts.some((c) => c.friction > 0)), labels: some((a) => a.contacts.length + a.sunk.length),
      trace: some((a) => a.data.paths.hand), target: some((a) => a.data.paths.target), support: some((a) => a.support),
      depths: some((a) => a.sunk.length), wheels: some((a) => a.data.wheels), modes: some((a) => a.contactTables.some((c) => c.mode)),
      pulls: some((a) => a.contactTables.some((c) => c.force.column(0).some((f) => f < 0))) }[layer];
  }

  // Heat of the windings R i²; squares of the currents if the motors have different resistances.
  heat() {
    const R = this.actors[0].data.resistance, one = R && this.actors.every((a) => a.data.resistance === R);
    return one ? ["current", "heat R i²", "W", (x) => R * x * x] : ["current", "heat ∝ i²", "A²", (x) => x * x];
  }

  // Signals of the motors for colouring the links.
  colourings() {
    const size = (x) => Math.abs(x), share = (x, limit) => Math.abs(x) / limit;
    const list = [["power", "electrical power |u i|", "W", size], this.heat(), ["torque", "torque", "", size], ["voltage", "voltage", "V", size],
      ["phi_dot", "joint rate", "rad/s", size], ["rating", "torque over rating", "rating", share, "torque"], ["stall", "torque over stall torque", "stall torque", share, "torque"],
      ["nominal_current", "current over rating", "rating", share, "current"]];
    return list.map(([name, text, unit, of, signal]) => ({ name, text, unit, of, signal: signal ?? name, limited: Boolean(signal) }))
      .filter((c) => this.actors.some((a) => a.signals.has(c.signal) && (!c.limited || Object.keys(a.data.limits[c.name] ?? {}).length)));
  }

  set(name, value) {
    if (name in this.layers) this.layers[name] = value;
    else this[name] = value;
    if (name === "playing" && value && this.time >= this.span[1]) this.time = this.start;
    if (name === "ghost") this.arrange();
    if (name === "ghost" || name === "theme") this.dress();
    if (name === "colouring") this.rate();
    if (name === "follow" && value) this.target = null;
    this.sync();
    this.show();
  }

  toggle(actor) {
    if (!actor.object.visible) this.admit(actor);
    else if (this.actors.filter((a) => a.object.visible).length > 1) {
      actor.object.visible = false;
      this.labelled = this.labelled.filter((a) => a !== actor);
    }
    this.arrange();
    this.dress();
  }

  camera(name) {
    this.set("follow", false);
    this.stage.look(name);
    this.sync();
  }

  seek(t) {
    this.time = Math.min(Math.max(t, this.span[0]), this.span[1]);
    this.live = false;
    this.show();
  }

  step(frames) {
    this.set("playing", false);
    const times = this.actors.find((a) => a.object.visible).times;
    let i = D.before(times, this.time + 1e-9);
    if (times[i + 1] <= this.time + 1e-9) i++;
    this.seek(times[Math.min(Math.max(i + frames, 0), times.length - 1)]);
  }

  faster(way) {
    const k = SPEEDS.indexOf(this.speed);
    this.set("speed", SPEEDS[Math.min(Math.max(k + way, 0), SPEEDS.length - 1)]);
  }

  // External frame: only its own content is shown.
  frame(frame, k = 0) {
    const actor = this.actors[k], sample = actor.emptySample();
    this.live = true;
    this.time = frame.time;
    Object.assign(sample, frame);
    actor.extend(sample);
    this.update([[actor, sample]]);
  }

  tick(now) {
    const passed = Math.min((now - (this.before ?? now)) / 1000, 0.25);
    this.before = now;
    if (this.playing && !this.live) {
      this.time += passed * this.speed;
      if (this.time >= this.span[1]) this.time = this.span[1], this.playing = false, this.sync();
      this.show();
    }
    if (!this.stage.changed) return;
    this.stage.draw();
    this.label();
  }

  show() {
    if (this.live) return;
    this.update(this.actors.filter((a) => a.object.visible).map((actor) => [actor, actor.at(this.time)]));
    this.plots.show(this.time);
  }

  update(pairs) {
    const start = performance.now();
    for (const [actor, sample] of pairs) actor.show(sample, this.layers, this.colours);
    this.cost = performance.now() - start;
    for (const [actor] of pairs) this.paint(actor);
    if (this.follow) this.chase(pairs[0][0]);
    document.getElementById("slider").value = this.time;
    document.getElementById("clock").textContent = `${this.time.toFixed(3)} s`;
    this.showStatus(pairs);
    this.stage.touch();
  }

  chase(actor) {
    actor.object.updateMatrixWorld(true);
    actor.handPosition(this.point);
    if (this.target) this.stage.follow(this.point.clone().add(this.target));
    else this.target = this.stage.controls.target.clone().sub(this.point);
  }

  // Scale of the colouring: the 98th percentile, so that a peak at the start does not darken the rest.
  rate() {
    const chosen = this.colourings().find((c) => c.name === this.colouring);
    this.rating = null;
    document.getElementById("scale").hidden = !chosen;
    if (!chosen) { for (const actor of this.actors) actor.paint(null); return; }
    const all = chosen.limited ? [] : this.actors.flatMap((a) => {
      const signal = a.signals.get(chosen.name), found = [];
      for (let k = 0; signal && k < signal.table.columns; k++) found.push(...Array.from(signal.table.column(k), chosen.of));
      return found;
    });
    const limit = chosen.name === "voltage" && this.actors[0].data.limit;
    const top = chosen.limited ? 1 : limit || Math.max(D.percentile(all, 0.98), 1e-12);
    this.rating = { ...chosen, top };
    const unit = chosen.unit || this.actors[0].signals.get(chosen.signal)?.unit || "";
    const [bar, ends] = document.getElementById("scale").children, c = bar.getContext("2d");
    for (let x = 0; x < 120; x++) c.fillStyle = App.heat(x / 119).getStyle(), c.fillRect(x, 0, 1, 8);
    ends.children[0].textContent = "0";
    ends.children[2].hidden = !chosen.limited;
    ends.children[2].style.color = this.colours.saturated;
    ends.children[1].textContent = chosen.limited ? unit : `${limit ? "limit " : "≥ "}${D.number(top, 3)} ${unit}`;
  }

  paint(actor) {
    if (!this.rating) return;
    const signal = actor.signals.get(this.rating.signal), found = new Map();
    if (!signal) return;
    const times = actor.axes[signal.axis].column(0);
    for (const [name, body] of actor.data.motors) {
      const k = signal.labels.indexOf(name);
      if (k < 0) continue;
      const limit = this.rating.limited ? actor.data.limits[this.rating.name][name] : null;
      if (this.rating.limited && !limit) continue;
      const value = this.rating.of(Plots.value({ times, values: signal.table.column(k) }, Math.min(this.time, times[times.length - 1])), limit);
      found.set(body, limit && value > 1 ? new THREE.Color(this.colours.saturated) : App.heat(value / this.rating.top));
    }
    actor.paint(found);
  }

  // From dark blue over grey to yellow (cividis), which is suitable for colour-blind readers.
  static heat(share) {
    const stops = [[30, 62, 120], [58, 80, 122], [102, 105, 112], [149, 143, 120], [203, 186, 105], [255, 234, 70]];
    const x = Math.min(Math.max(share || 0, 0), 1) * 5, k = Math.min(Math.floor(x), 4), f = x - k;
    return new THREE.Color().setRGB(...[0, 1, 2].map((i) => (stops[k][i] + f * (stops[k + 1][i] - stops[k][i])) / 255));
  }

  // Status line: contacts, wheels, support, saturated motors.
  showStatus(pairs) {
    const lines = [];
    for (const [actor] of pairs) {
      // A live page has no table of contacts. If there are many, open ones are not listed.
      const listed = (this.live ? actor.contacts : []).filter(({ state }, _, all) => all.length <= CONES || (state.force !== null && state.state !== "open"));
      const parts = listed.map(({ state }) => state.force === null || state.state === "open" ? `${state.name}: open`
        : `${state.name}: ${D.number(state.force, 3)} N, ${state.state}`);
      // For a live gripper, only open or closed is known.
      if (actor.data.states && !actor.live) parts.unshift(`gripper: ${actor.data.states[actor.shown.gripper]}`);
      actor.saturated = this.saturated(actor);
      actor.mark(actor.saturated);
      if (actor.saturated.length) parts.push(`voltage limit: ${actor.saturated.map((name) => this.plots.called(name)).join(", ")}`);
      if (actor.data.wheels) {
        const up = actor.data.wheels.names.filter((_, k) => !(actor.shown.wheels[k] > 0));
        if (up.length) parts.push(`lifted: ${up.map((name) => this.plots.called(name)).join(", ")}`);
      }
      const deep = actor.sunk.filter((one) => one.depth !== null).sort((a, b) => b.depth - a.depth);
      if (deep.length) parts.push(`below ${deep[0].point.surface}: ${deep.slice(0, 3).map((one) => `${one.point.name} ${D.number(1e3 * one.depth, 2)} mm`).join(", ")}${deep.length > 3 ? " …" : ""}`);
      if (actor.support?.inside === false) parts.push(`${actor.data.pressure.name} outside the support`);
      if (parts.length > 6) parts.splice(6, parts.length, `… ${parts.length - 6} more`);
      if (parts.length && this.labelled.includes(actor)) lines.push([actor, parts.join(" · ")]);
    }
    this.table.show();
    document.getElementById("status").replaceChildren(...lines.map(([actor, text]) => {
      const line = D.element("div", {}, this.actors.length > 1 ? D.element("b", { textContent: `${actor.name} ` }) : "", text);
      if (this.actors.length > 1) line.firstChild.style.color = this.colourOf(actor);
      return line;
    }));
  }

  saturated(actor) {
    const limit = actor.data.limit, signal = actor.signals.get("voltage");
    if (!limit || !signal || this.live) return [];
    const times = actor.axes[signal.axis].column(0);
    return signal.labels.filter((_, k) => Math.abs(Plots.value({ times, values: signal.table.column(k) }, this.time)) > 0.998 * limit);
  }

  about(actor, k, text) {
    const body = actor.bodies[k], p = body.object.position.toArray().map((x) => D.number(x, 4)).join(", "), found = [...(text ? [text] : []), `at (${p}) m`];
    for (const [name, moved] of actor.data.motors)
      if (moved === k)
        for (const wanted of ["q", "v", "torque", "power", "phi", "phi_dot"]) {
          const signal = actor.signals.get(wanted), column = signal ? signal.labels.indexOf(name) : -1;
          if (column >= 0) found.push(`${signal.words} ${D.number(Plots.value({ times: actor.axes[signal.axis].column(0), values: signal.table.column(column) }, this.time))} ${signal.unit}`);
        }
    return found;
  }

  // Labels: names of variants, forces at contacts, depths below surfaces. A label that would cover a larger force is omitted.
  label() {
    const taken = [], several = !this.ghost && this.actors.filter((a) => a.object.visible).length > 1;
    const put = (box, point, text, colour, shown) => {
      const at = shown ? this.stage.project(point, point) : null, wide = 6.6 * text.length + 8;
      write(box, at, text, colour, wide);
    };
    const write = (box, at, text, colour, wide) => {
      const free = at && !taken.some(([x, y, w]) => at[0] < x + w && x < at[0] + wide && Math.abs(at[1] - y) < 15);
      box.hidden = !free;
      if (!free) return;
      taken.push([at[0], at[1], wide]);
      box.textContent = text;
      box.style.color = colour;
      box.style.transform = `translate(${Math.round(at[0])}px, ${Math.round(at[1])}px)`;
    };
    for (const { actor, box } of this.names) {
      const left = several && actor.object.visible ? this.leftmost(actor) : null, wide = 7.5 * actor.name.length;
      write(box, left && [Math.max(left[0] - wide - 14, 4), left[1] - 9], actor.name, this.colourOf(actor), wide);
    }
    const on = (actor) => this.layers.labels && this.labelled.includes(actor) && !(this.ghost && actor.ghost);
    for (const { actor, contact: { state, at }, box } of [...this.tags].sort((a, b) => Math.abs(b.contact.state.force ?? 0) - Math.abs(a.contact.state.force ?? 0)))
      put(box, this.point.copy(at).add(actor.object.position), `${state.name} ${D.number(state.force, 3)} N`, state.colour, on(actor) && state.shown);
    for (const { actor, one, box } of this.deep)
      put(box, this.point.copy(one.at).add(actor.object.position), `↓ ${D.number(1e3 * one.depth, 2)} mm`, one.colour, on(actor) && one.mark.visible && one.depth >= 1e-3);
  }

  // Leftmost corner of a robot in the window.
  leftmost(actor) {
    let left = null;
    for (const { mesh } of actor.bodies.flatMap((body) => body.paint)) {
      if (!mesh.geometry.boundingBox) mesh.geometry.computeBoundingBox();
      const { min, max } = mesh.geometry.boundingBox;
      for (let k = 0; k < 8; k++) {
        this.point.set(k & 1 ? min.x : max.x, k & 2 ? min.y : max.y, k & 4 ? min.z : max.z).applyMatrix4(mesh.matrixWorld);
        const at = this.stage.project(this.point, this.point);
        if (at && !(at[0] >= left?.[0])) left = at;
      }
    }
    return left;
  }

  image() {
    this.stage.draw();
    return this.stage.canvas.toDataURL("image/png");
  }

  screenshot() {
    const link = D.element("a", { href: this.image(), download: `${document.title.replace(/\W+/g, "_")}_${this.time.toFixed(3)}s.png` });
    link.click();
  }

  state() {
    return { time: this.time, playing: this.playing, speed: this.speed, theme: this.theme, ghost: this.ghost, follow: this.follow,
      colouring: this.colouring, camera: this.stage.preset, plots: this.plots.plots.map((p) => p.signal),
      records: this.actors.filter((a) => a.object.visible).map((a) => a.state()) };
  }
}

// Table of the contacts of the labelled variants at the current instant.
class ContactTable {
  constructor(box, app) {
    Object.assign(this, { box, app, rows: [], key: null });
  }

  build(actors) {
    const cells = (names, tag) => names.map((textContent) => D.element(tag, { textContent }));
    this.rows = [];
    const body = actors.flatMap((actor) => {
      const title = D.element("th", { colSpan: 5, textContent: actor.name });
      title.style.color = this.app.colourOf(actor);
      const rows = actor.contacts.map((contact) => {
        const entry = cells([contact.name, "", "", "", ""], "td");
        entry[0].title = `${contact.name} on ${contact.contact.surface}`;
        this.rows.push({ contact, entry });
        return D.element("tr", {}, ...entry);
      });
      return this.app.actors.length > 1 ? [D.element("tr", {}, title), ...rows] : rows;
    });
    const head = cells(["contact", "normal [N]", "tangential [N]", "friction ratio", "state"], "th");
    head[3].title = "tangential force relative to the friction limit (friction coefficient × normal force)";
    this.box.querySelector("table").replaceChildren(D.element("thead", {}, D.element("tr", {}, ...head)), D.element("tbody", {}, ...body));
  }

  show() {
    const actors = this.app.live ? [] : this.app.actors.filter((a) => this.app.labelled.includes(a) && a.contacts.length);
    this.box.hidden = !actors.length;
    const key = this.app.theme + actors.map((a) => `${a.index} ${a.slot}`).join();
    if (key !== this.key) this.build(actors);
    this.key = key;
    for (const { contact: { state }, entry } of this.rows) {
      const open = state.force === null || !Number.isFinite(state.force) || state.state === "open";
      const texts = open ? ["–", "–", "–", "open"] : [D.number(state.force, 3), D.number(state.friction, 3), state.ratio === null ? "–" : state.ratio.toFixed(2), state.state];
      texts.forEach((text, k) => { entry[k + 1].textContent = text; });
      entry[4].style.color = state.dot;
      entry[0].parentElement.classList.toggle("off", open);
    }
  }
}

const dynsim = { app: null };
dynsim.ready = D.unpack(document.getElementById("data").textContent).then((data) => {
  dynsim.app = new App(data);
  for (const name of ["seek", "state", "frame", "set", "camera", "image"]) dynsim[name] = dynsim.app[name].bind(dynsim.app);
  Object.defineProperty(dynsim, "cost", { get: () => dynsim.app.cost });
  document.documentElement.dataset.ready = "yes";
}).catch((error) => {
  const box = document.getElementById("message");
  box.textContent = `Cannot show this page: ${error.message}`;
  box.hidden = false;
  console.error(error);
});
window.dynsim = dynsim;
