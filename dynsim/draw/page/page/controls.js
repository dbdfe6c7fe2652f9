"use strict";
// Buttons, slider and keys that control the player `app` of main.js.

const KEYS = [
  ["space", "play, pause"], ["← →", "one frame back, forward; with shift ten"], ["home end", "start, end"],
  ["+ −", "faster, slower"], ["1 2 3 4", "view from a corner, the side, the front, above"], ["f", "follow the hand"],
  ["g", "side by side or overlaid"], ["c", "next colouring of the links"], ["d", "dark or light"],
  ["p", "screenshot"], ["?", "legend and keys"],
];
// Legend entries, with the layer or the part of a record that they need.
const SIGNS = [
  ["forces", "push", "▲", "normal force: the surface pushes"], ["pulls", "pull", "▼", "the surface pulls"],
  ["cones", "friction", "▲", "total force with friction, and the friction cone"],
  ["modes", "stick", "●", "contact sticks"], ["modes", "slip", "●", "contact slips"], ["modes", "open", "●", "contact open"],
  ["depths", "sunk", "●", "joint or hand below a surface by more than the link radius (↓ depth); surfaces act on declared contact points only"],
  ["trace", "hand", "━", "path of the hand"], ["target", "target", "╍", "target of the hand"],
  ["support", "support", "■", "support polygon"], ["support", "target", "◎", "centre of pressure or of mass; orange outside the support polygon"],
  ["wheels", "down", "●", "wheel on the ground; lifted wheels are white"],
];
const SPEEDS = [0.05, 0.1, 0.25, 0.5, 1, 2, 5, 10];
const ABOUT = { depths: "joints and hand below a surface, with depth (↓)" };
const EVENTS = { landing: "▼", lift_off: "▲", bounce: "●", slip_start: "▶", slip_stop: "■", stop_hit: "✚", stop_left: "✖", tip_over: "⚠" };

function wire(app) {
  const $ = (id) => document.getElementById(id);
  const button = (parent, text, title, act, name) => {
    const made = D.element("button", { textContent: text, title, onclick: act });
    if (name) made.dataset.name = name;
    $(parent).append(made);
    return made;
  };

  for (const [name, text, key] of [["iso", "corner", 1], ["side", "side", 2], ["front", "front", 3], ["top", "top", 4]])
    button("cameras", text, `view (${key})`, () => app.camera(name), name);
  const follow = button("cameras", "follow", "follow the hand (f)", () => app.set("follow", !app.follow));
  const switches = [["forces", "forces"], ["cones", "friction cones"], ["trace", "hand path"], ["target", "target"], ["support", "support"], ["depths", "depths"], ["labels", "labels"]]
    .filter(([name]) => app.has(name)).map(([name, text]) =>
      [name, button("layers", text, `show or hide: ${ABOUT[name] ?? text}`, () => app.set(name, !app.layers[name]))]);
  const layout = app.actors.length > 1 ? button("layers", "", "side by side or overlaid (g)", () => app.set("ghost", !app.ghost)) : null;

  for (const value of SPEEDS) $("speed").append(D.element("option", { value, textContent: `${value}×` }));
  $("speed").onchange = () => app.set("speed", Number($("speed").value));
  for (const [name, text] of [["", "plain"], ...app.colourings().map((c) => [c.name, c.text])])
    $("colour").append(D.element("option", { value: name, textContent: text }));
  $("colouring").hidden = !app.colourings().length;
  $("colour").onchange = () => app.set("colouring", $("colour").value);
  $("play").onclick = () => app.set("playing", !app.playing);
  $("slider").oninput = () => {
    // Read first, because app.set moves the slider.
    const time = Number($("slider").value);
    app.set("playing", false);
    app.seek(time);
  };
  $("theme").onclick = () => app.set("theme", app.theme === "dark" ? "light" : "dark");
  $("shot").onclick = () => app.screenshot();
  $("help").onclick = () => $("keys").open ? $("keys").close() : $("keys").showModal();
  const signs = SIGNS.filter(([layer]) => app.has(layer)).map(([, colour, sign, meaning]) => {
    const cell = D.element("th", { textContent: sign });
    cell.dataset.colour = colour;
    return D.element("tr", {}, cell, D.element("td", { textContent: meaning }));
  });
  if (signs.length) $("keys").append(D.element("h2", { textContent: "Legend" }), D.element("table", { id: "signs" }, ...signs));
  $("keys").append(D.element("h2", { textContent: "Keys" }), D.element("table", {}, ...KEYS.map(([key, action]) =>
    D.element("tr", {}, D.element("th", { textContent: key }), D.element("td", { textContent: action })))),
    D.element("p", { textContent: "Drag to rotate, right-drag or use two fingers to move, scroll to zoom. In plots: drag to zoom, double-click to show all, click to go to a time." }),
    D.element("button", { textContent: "close", onclick: () => $("keys").close() }));

  app.actors.forEach((actor) => {
    const chip = D.element("button", { className: "chip", title: "show or hide", onclick: () => app.toggle(actor) }, D.element("i"), actor.name);
    actor.chip = chip;
    if (actor.data.measured && actor.name !== "measured") chip.append(D.element("em", { textContent: "measured" }));
    if (!actor.data.complete) chip.append(D.element("em", { textContent: "incomplete", title: `ended early, at ${D.number(actor.span[1])} s` }));
    if (app.actors.length > 1 || chip.querySelector("em")) $("variants").append(chip);
  });
  const boxes = app.actors.length > LABELLED ? chooser(app, $("choose"), $("chooser")) : [];

  const first = app.span[0], long = app.span[1] - first || 1;
  $("slider").min = first;
  $("slider").max = app.span[1];
  app.actors.forEach((actor, row) => {
    for (const [time, kind, name, value] of actor.data.events.slice(0, 400)) {
      const sign = D.element("i", { textContent: EVENTS[kind] ?? "◆", title: `${D.number(time)} s: ${kind.replace(/_/g, " ")} ${name}${value === null ? "" : " " + D.number(value)}` });
      sign.style.left = `${(100 * (time - first)) / long}%`;
      sign.dataset.actor = row;
      sign.onclick = () => app.seek(time);
      $("marks").append(sign);
    }
  });

  const keys = {
    " ": () => app.set("playing", !app.playing), ArrowLeft: (e) => app.step(e.shiftKey ? -10 : -1), ArrowRight: (e) => app.step(e.shiftKey ? 10 : 1),
    Home: () => app.seek(app.span[0]), End: () => app.seek(app.span[1]), "+": () => app.faster(1), "=": () => app.faster(1), "-": () => app.faster(-1),
    1: () => app.camera("iso"), 2: () => app.camera("side"), 3: () => app.camera("front"), 4: () => app.camera("top"),
    f: () => app.set("follow", !app.follow), g: () => app.set("ghost", !app.ghost), d: () => $("theme").click(), p: () => app.screenshot(),
    "?": () => $("help").click(), c: () => { const s = $("colour"); s.selectedIndex = (s.selectedIndex + 1) % s.options.length; s.onchange(); },
  };
  addEventListener("keydown", (event) => {
    const at = event.target;
    if (event.ctrlKey || event.metaKey || event.altKey || at.tagName === "SELECT" || $("keys").open) return;
    if (at.tagName === "BUTTON" && event.key === " ") return;
    const act = keys[event.key];
    if (!act) return;
    event.preventDefault();
    act(event);
  });

  // Update the controls after a change.
  return () => {
    $("play").textContent = app.playing ? "❚❚" : "▶";
    $("play").setAttribute("aria-label", app.playing ? "pause" : "play");
    follow.classList.toggle("on", app.follow);
    for (const [name, one] of switches) one.classList.toggle("on", app.layers[name]);
    if (layout) layout.textContent = app.ghost ? "overlaid" : "side by side";
    for (const one of $("cameras").querySelectorAll("[data-name]")) one.classList.toggle("on", app.stage.preset === one.dataset.name);
    $("speed").value = app.speed;
    const many = app.actors.filter((a) => a.object.visible).length > 2 * LABELLED;
    $("colour").value = app.colouring;
    for (const actor of app.actors) {
      actor.chip.classList.toggle("off", !actor.object.visible);
      actor.chip.hidden = app.actors.length > LABELLED && (!actor.object.visible || many);
      actor.chip.firstChild.style.background = app.colourOf(actor);
    }
    for (const { actor, shown, labelled } of boxes) shown.checked = actor.object.visible, labelled.checked = app.labelled.includes(actor);
    if (boxes.length) $("choose").textContent = `variants: ${app.actors.filter((a) => a.object.visible).length} of ${app.actors.length}`;
    for (const cell of $("keys").querySelectorAll("[data-colour]")) cell.style.color = D.palette[app.theme][cell.dataset.colour];
    for (const sign of $("marks").children) {
      const actor = app.actors[sign.dataset.actor];
      sign.hidden = !actor.object.visible;
      sign.style.color = app.actors.length > 1 ? app.colourOf(actor) : "";
    }
  };
}

// List of the variants with check boxes that show and label them.
function chooser(app, button, list) {
  const tick = (act) => D.element("input", { type: "checkbox", onchange: act });
  const boxes = app.actors.map((actor) => {
    const labelled = tick(() => app.mark(actor, labelled.checked));
    return { actor, shown: tick(() => app.toggle(actor)), labelled };
  });
  const choose = (actors) => {
    for (const actor of app.actors) actor.object.visible = false;
    app.labelled = [];
    for (const actor of actors) app.admit(actor);
    app.arrange();
    app.dress();
  };
  const cell = (tag, ...content) => D.element(tag, {}, ...content);
  list.append(D.element("div", { className: "group" }, D.element("button", { textContent: `first ${LABELLED}`, onclick: () => choose(app.actors.slice(0, LABELLED)) }),
    D.element("button", { textContent: "all", onclick: () => choose(app.actors) })),
  D.element("table", {}, cell("tr", cell("th", "show"), cell("th", "label"), cell("th", "variant")), ...boxes.map(({ actor, shown, labelled }) =>
    cell("tr", cell("td", shown), cell("td", labelled), D.element("td", { textContent: actor.name, onclick: () => app.toggle(actor) })))),
  D.element("small", { textContent: `at most ${LABELLED} variants have labels and a table of contacts` }));
  button.hidden = false;
  button.onclick = () => { list.hidden = !list.hidden; };
  addEventListener("pointerdown", (event) => { if (!list.contains(event.target) && event.target !== button) list.hidden = true; });
  return boxes;
}

// Tooltip of the body under the pointer: name, position, signals of its motor.
function hovering(app, canvas, box) {
  const ray = new THREE.Raycaster(), at = new THREE.Vector2();
  let last = 0;
  canvas.addEventListener("pointerleave", () => { box.hidden = true; });
  canvas.addEventListener("pointermove", (event) => {
    if (event.buttons || performance.now() - last < 60) { box.hidden = box.hidden || event.buttons > 0; return; }
    last = performance.now();
    const area = canvas.getBoundingClientRect();
    at.set(((event.clientX - area.left) / area.width) * 2 - 1, 1 - ((event.clientY - area.top) / area.height) * 2);
    ray.setFromCamera(at, app.stage.camera);
    for (const actor of app.actors) {
      if (!actor.object.visible) continue;
      const meshes = actor.bodies.flatMap((b, k) => b.paint.map((p) => Object.assign(p.mesh, { bodyIndex: k })));
      const hit = ray.intersectObjects(meshes, false)[0];
      if (!hit) continue;
      const k = hit.object.bodyIndex, body = actor.bodies[k];
      box.replaceChildren(D.element("b", { textContent: app.actors.length > 1 ? `${actor.name}: ${body.name}` : body.name }),
        ...app.about(actor, k, hit.object.userData.text).map((text) => D.element("div", { textContent: text })));
      box.style.left = `${Math.min(event.clientX - area.left + 14, area.width - 170)}px`;
      box.style.top = `${event.clientY - area.top + 14}px`;
      box.hidden = false;
      return;
    }
    box.hidden = true;
  });
}
