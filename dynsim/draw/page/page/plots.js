"use strict";
// Curves of signals over time, with a cursor at the time of the scene. Drag to zoom, double-click to show all, click to
// go to a time.

// Maximum number of curves that a plot names (the largest).
const NAMED = 6;

class Plots {
  constructor(parent, actors, on) {
    this.parent = parent;
    this.actors = actors;
    this.on = on;
    this.plots = [];
    this.range = null;
    this.names = [...new Set(actors.flatMap((a) => [...a.signals.keys()]))];
  }

  add(name, column = "all") {
    const signal = this.names.includes(name) ? name : this.names[0];
    if (!signal) return null;
    const choice = D.element("select", { ariaLabel: "signal" }, ...this.names.map((n) => D.element("option", { value: n, textContent: this.titled(n) })));
    const columns = D.element("select", { ariaLabel: "column" });
    const close = D.element("button", { textContent: "×", ariaLabel: "remove plot" });
    const canvas = D.element("canvas"), over = D.element("canvas");
    const frame = D.element("div", { className: "curves" }, canvas, over);
    const values = D.element("div", { className: "values" });
    const box = D.element("div", { className: "plot" }, D.element("div", { className: "bar" }, choice, columns, close), frame, values);
    const plot = { box, canvas, over, choice, columns, values, signal, column };
    choice.value = signal;
    choice.onchange = () => { plot.signal = choice.value; plot.column = "all"; this.fill(plot); this.draw(plot); };
    columns.onchange = () => { plot.column = columns.value; this.draw(plot); };
    close.onclick = () => { box.remove(); this.plots.splice(this.plots.indexOf(plot), 1); };
    this.point(plot);
    this.parent.append(box);
    this.plots.push(plot);
    this.fill(plot);
    plot.column = column;
    columns.value = column;
    new ResizeObserver(() => this.draw(plot)).observe(canvas);
    return plot;
  }

  fill(plot) {
    const labels = this.actors.map((a) => a.signals.get(plot.signal)?.labels).find(Boolean) ?? [];
    plot.columns.replaceChildren(D.element("option", { value: "all", textContent: labels.length ? "all" : "–" }),
      ...labels.map((name) => D.element("option", { value: name, textContent: this.called(name) })));
    plot.columns.hidden = !labels.length;
  }

  // Name and unit of a signal.
  titled(name) {
    const { words, unit } = this.actors.map((a) => a.signals.get(name)).find(Boolean);
    return unit && unit !== "1" ? `${words} [${unit}]` : words;
  }

  // Display name of a column: motors of wheels have special names.
  called(label) {
    return this.actors.map((a) => a.data.names[label]).find(Boolean) ?? label;
  }

  // Curves of a plot: {actor, label, times, values, colour, dash}.
  curves(plot) {
    const shown = this.actors.filter((a) => a.object.visible), found = [];
    shown.forEach((actor) => {
      const signal = actor.signals.get(plot.signal);
      if (!signal) return;
      const times = actor.axes[signal.axis].column(0);
      for (let k = 0; k < signal.table.columns; k++) {
        const label = signal.labels[k] ?? "";
        if (plot.column !== "all" && label !== plot.column) continue;
        const several = shown.length > 1;
        const colour = several ? this.on.colour(actor) : this.on.palette()[k % 7];
        found.push({ actor, label: this.called(label), times, values: signal.table.column(k), colour, dash: several ? [[], [5, 2], [2, 2], [7, 2, 2, 2]][k % 4] : k < 7 ? [] : [4, 2], unit: signal.unit });
      }
    });
    return found;
  }

  draw(plot) {
    const { canvas } = plot, ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
    if (!box.width) return;
    for (const one of [canvas, plot.over]) one.width = Math.round(box.width * ratio), one.height = Math.round(box.height * ratio);
    const c = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
    c.scale(ratio, ratio);
    const ink = style.getPropertyValue("--muted"), rule = style.getPropertyValue("--rule");
    const [t0, t1] = this.range ?? this.on.span();
    const area = { x: 44, y: 8, w: box.width - 50, h: box.height - 24 };
    const curves = this.curves(plot);
    const [low, high] = Plots.limits(curves, t0, t1);
    plot.area = area;
    plot.span = [t0, t1];
    const X = (t) => area.x + (t - t0) / (t1 - t0 || 1) * area.w, Y = (v) => area.y + area.h * (1 - (v - low) / (high - low));
    c.font = "10px system-ui, sans-serif";
    c.fillStyle = ink;
    c.strokeStyle = rule;
    c.lineWidth = 1;
    c.textAlign = "right";
    const marks = Plots.ticks(low, high, Math.max(2, area.h / 28)), step = marks[1] - marks[0];
    // As many decimals as distinguish the ticks.
    const shown = (v) => (Math.abs(v) < 1e5 && step > 1e-4 ? v.toFixed(Math.max(0, -Math.floor(Math.log10(step) + 1e-9))).replace("-", "−") : D.number(v));
    for (const v of marks) {
      c.beginPath(), c.moveTo(area.x, Math.round(Y(v)) + 0.5), c.lineTo(area.x + area.w, Math.round(Y(v)) + 0.5), c.stroke();
      c.fillText(shown(v), area.x - 4, Y(v) + 3);
    }
    c.textAlign = "center";
    for (const t of Plots.ticks(t0, t1, area.w / 60)) {
      // Keep the last number inside the canvas.
      const text = D.number(t), half = c.measureText(text).width / 2;
      c.fillText(text, Math.min(X(t), box.width - half), box.height - 4);
    }
    c.textAlign = "left";
    c.save();
    c.beginPath(), c.rect(area.x, 0, area.w, box.height - 14), c.clip();
    c.lineJoin = "round";
    curves.forEach((curve) => Plots.line(c, curve, X, Y, t0, t1, area.w));
    c.restore();
    plot.drawn = curves;
    plot.named = Plots.largest(curves, t0, t1, NAMED);
    plot.X = X;
    plot.Y = Y;
    this.cursor(plot, this.time ?? t0);
  }

  static line(c, { times, values, colour, dash }, X, Y, t0, t1, width) {
    const first = Math.max(0, D.before(times, t0)), last = Math.min(times.length - 1, D.before(times, t1) + 1);
    const bin = Math.max(1, Math.floor((last - first) / (2 * width)));
    c.strokeStyle = colour;
    c.lineWidth = 1.3;
    c.setLineDash(dash);
    c.beginPath();
    let down = false;
    const to = (i) => {
      const v = values[i];
      if (!(v - v === 0)) { down = false; return; }
      if (down) c.lineTo(X(times[i]), Y(v));
      else c.moveTo(X(times[i]), Y(v));
      down = true;
    };
    for (let i = first; i <= last; i += bin) {
      if (bin === 1) { to(i); continue; }
      let a = i, b = i;
      for (let j = i; j < Math.min(i + bin, last + 1); j++) {
        if (values[j] < values[a]) a = j;
        if (values[j] > values[b]) b = j;
      }
      to(Math.min(a, b));
      if (a !== b) to(Math.max(a, b));
    }
    c.stroke();
    c.setLineDash([]);
  }

  // At most `most` curves with the largest root mean square in the visible range, in their order.
  static largest(curves, t0, t1, most) {
    const effort = curves.map(({ times, values }) => {
      const first = D.before(times, t0), last = Math.min(times.length - 1, D.before(times, t1) + 1);
      let sum = 0;
      for (let i = first; i <= last; i++) if (Number.isFinite(values[i])) sum += values[i] ** 2;
      return sum / (last - first + 1);
    });
    const order = curves.map((_, k) => k).sort((a, b) => effort[b] - effort[a] || a - b);
    return order.slice(0, most).sort((a, b) => a - b);
  }

  // Range of the visible values, cutting off a peak that would compress the rest.
  static limits(curves, t0, t1) {
    let low = Infinity, high = -Infinity, all = [];
    for (const { times, values } of curves) {
      const first = D.before(times, t0), last = Math.min(times.length - 1, D.before(times, t1) + 1), step = Math.max(1, (last - first) >> 9);
      for (let i = first; i <= last; i += 1) {
        const v = values[i];
        if (!(v - v === 0)) continue;
        if (v < low) low = v;
        if (v > high) high = v;
        if ((i - first) % step === 0) all.push(v);
      }
    }
    if (low > high) return [-1, 1];
    all.sort((a, b) => a - b);
    const a = all[Math.floor(0.01 * all.length)], b = all[Math.min(all.length - 1, Math.floor(0.99 * all.length))], mid = b - a;
    if (mid > 0 && high - low > 4 * mid) low = Math.max(low, a - 0.6 * mid), high = Math.min(high, b + 0.6 * mid);
    // A constant with rounding errors is a flat line.
    const size = Math.max(Math.abs(low), Math.abs(high)), room = high - low > 1e-4 * size ? 0.06 * (high - low) : Math.max(0.05 * size, 1e-9);
    return [low - room, high + room];
  }

  static ticks(low, high, count) {
    const step = Stage.round((high - low) / Math.max(count, 1)), found = [];
    for (let v = Math.ceil(low / step) * step; v <= high + 1e-9 * step; v += step) found.push(Math.abs(v) < 1e-9 * step ? 0 : v);
    // A scale needs at least two numbers.
    return found.length > 1 || count > 12 ? found : Plots.ticks(low, high, count + 1);
  }

  cursor(plot, t) {
    if (!plot.drawn) return;
    const c = plot.over.getContext("2d"), ratio = window.devicePixelRatio || 1;
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, plot.over.width, plot.over.height);
    const at = plot.hover ?? t, x = plot.X(at);
    if (x >= plot.area.x - 1 && x <= plot.area.x + plot.area.w + 1) {
      c.strokeStyle = getComputedStyle(document.documentElement).getPropertyValue("--ink");
      c.lineWidth = 1;
      c.beginPath(), c.moveTo(x, 2), c.lineTo(x, plot.area.y + plot.area.h), c.stroke();
    }
    if (plot.drag) {
      c.fillStyle = "rgba(90,150,220,.25)";
      c.fillRect(Math.min(...plot.drag), plot.area.y, Math.abs(plot.drag[1] - plot.drag[0]), plot.area.h);
    }
    const list = plot.named.map((k) => plot.drawn[k]).map((curve) => {
      const name = [this.actors.length > 1 ? curve.actor.name : "", curve.label].filter(Boolean).join(" ");
      const item = D.element("span", {}, D.element("i"), `${name ? name + " " : ""}${D.number(Plots.value(curve, at))}`);
      item.firstChild.style.background = curve.colour;
      return item;
    });
    const more = plot.drawn.length - list.length;
    if (more) list.push(D.element("span", { textContent: `… ${more} smaller`, title: "the curves with the largest rms in the visible range are named" }));
    plot.values.replaceChildren(...list);
  }

  static value({ times, values }, t) {
    if (times.length < 2) return values[0];
    if (t < times[0] || t > times[times.length - 1]) return NaN;
    const i = D.before(times, t), share = (t - times[i]) / (times[i + 1] - times[i] || 1);
    return share === 0 ? values[i] : values[i] + share * (values[i + 1] - values[i]);
  }

  show(t) {
    this.time = t;
    for (const plot of this.plots) this.cursor(plot, t);
  }

  redraw() {
    for (const plot of this.plots) this.draw(plot);
  }

  zoom(range) {
    this.range = range;
    this.redraw();
  }

  point(plot) {
    const canvas = plot.over, x = (event) => event.clientX - canvas.getBoundingClientRect().left;
    const time = (px) => plot.span[0] + (px - plot.area.x) / plot.area.w * (plot.span[1] - plot.span[0]);
    canvas.onpointerdown = (event) => { plot.drag = [x(event), x(event)]; canvas.setPointerCapture(event.pointerId); };
    canvas.onpointermove = (event) => {
      if (plot.drag) plot.drag[1] = x(event);
      plot.hover = event.pointerType === "mouse" || plot.drag ? time(x(event)) : null;
      this.cursor(plot, this.time);
    };
    canvas.onpointerleave = () => { plot.hover = null; this.cursor(plot, this.time); };
    canvas.onpointerup = () => {
      const drag = plot.drag;
      plot.drag = plot.hover = null;
      if (!drag) return;
      const [a, b] = [time(Math.min(...drag)), time(Math.max(...drag))];
      if (Math.abs(drag[1] - drag[0]) < 5) this.on.seek(a);
      else this.zoom([Math.max(a, this.on.span()[0]), Math.min(b, this.on.span()[1])]);
    };
    canvas.ondblclick = () => this.zoom(null);
  }
}
