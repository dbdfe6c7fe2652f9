"use strict";
// Marks in the scene: force arrows, friction cones, contacts, paths, the support polygon. Drawn on top if they would
// otherwise be hidden.
const M = {};

M.above = { depthTest: false, depthWrite: false, transparent: true };

// Arrow along z: the shaft is scaled to the length, the head is not.
M.Arrow = class {
  constructor(parent, radius, order) {
    this.radius = radius;
    this.material = new THREE.MeshBasicMaterial({ ...M.above });
    const shaft = new THREE.CylinderGeometry(radius, radius, 1, 12).rotateX(Math.PI / 2).translate(0, 0, 0.5);
    const head = new THREE.ConeGeometry(2.6 * radius, 6 * radius, 16).rotateX(Math.PI / 2).translate(0, 0, -3 * radius);
    this.shaft = new THREE.Mesh(shaft, this.material);
    this.head = new THREE.Mesh(head, this.material);
    this.object = new THREE.Group();
    this.object.add(this.shaft, this.head);
    this.object.visible = false;
    for (const part of [this.shaft, this.head]) part.renderOrder = order;
    parent.add(this.object);
  }

  // From a point along a unit vector, not shorter than the head.
  set(from, along, length, colour) {
    const long = Math.max(length, 8 * this.radius);
    this.object.visible = true;
    this.object.position.copy(from);
    this.object.quaternion.setFromUnitVectors(M.z, along);
    this.shaft.scale.z = long - 5 * this.radius;
    this.head.position.z = long;
    this.material.color.set(colour);
    this.colour = colour;
  }

  hide() {
    this.object.visible = false;
  }
};
M.z = new THREE.Vector3(0, 0, 1);

// One contact: its state, the normal force, and the total force within its friction cone.
M.Contact = class {
  constructor(parent, contact, size) {
    this.name = contact.name;
    this.contact = contact;
    this.size = size;
    this.at = new THREE.Vector3();
    this.normal = new THREE.Vector3();
    this.foot = new THREE.Vector3();
    this.along = new THREE.Vector3();
    this.state = { name: contact.name, force: null, friction: null, ratio: null, state: "", colour: "" };
    this.push = new M.Arrow(parent, 0.035 * size, 20);
    this.slide = new M.Arrow(parent, 0.018 * size, 19);
    this.dot = new THREE.Mesh(new THREE.SphereGeometry(0.07 * size, 16, 12), new THREE.MeshBasicMaterial({ ...M.above }));
    this.dot.renderOrder = 21;
    const angle = Math.atan(contact.friction), high = 0.9 * size;
    const cone = new THREE.ConeGeometry(high * Math.tan(angle), high, 36, 1, true).rotateX(-Math.PI / 2).translate(0, 0, 0.5 * high);
    this.cone = new THREE.Mesh(cone, new THREE.MeshBasicMaterial({ ...M.above, opacity: 0.2, side: THREE.DoubleSide }));
    this.cone.renderOrder = 18;
    parent.add(this.dot, this.cone);
  }

  // force [N] along the normal, tangent (x, y, z) [N], mode 0 open, 1 slides, 2 sticks or null; at: position of the force
  // on a sphere or capsule; default: the point of the body.
  show(body, now, scale, layers, colours) {
    const { force, mode } = now;
    if (now.at) this.at.set(...now.at);
    else this.at.set(...this.contact.p).applyQuaternion(body.quaternion).add(body.position);
    this.normal.set(...now.normal).normalize();
    if (!now.at && this.contact.radius) this.at.addScaledVector(this.normal, -this.contact.radius);
    const open = mode === 0 || !Number.isFinite(force), pulls = force < 0;
    const slip = Math.hypot(...now.tangent), shown = layers.forces && !open && force !== 0;
    const long = this.size * Math.min(Math.sqrt(Math.abs(force) / scale), 1.6);
    const colour = pulls ? colours.pull : colours.push;
    // A pulling force points into the surface, where it would be hidden: its arrow is above, with the head at the contact.
    if (shown && pulls) {
      const high = Math.max(long, 8 * this.push.radius);
      this.foot.copy(this.normal).multiplyScalar(high).add(this.at);
      this.push.set(this.foot, this.along.copy(this.normal).negate(), high, colour);
    } else if (shown) this.push.set(this.at, this.normal, long, colour);
    else this.push.hide();
    // The total force with friction, within the cone; like the normal force, it points to the contact if it pulls.
    if (shown && slip > 1e-3 * scale) {
      this.along.set(...now.tangent).addScaledVector(this.normal, force);
      const all = this.size * Math.min(Math.sqrt(this.along.length() / scale), 1.6), high = Math.max(all, 8 * this.slide.radius);
      this.along.normalize();
      this.slide.set(pulls ? this.foot.copy(this.along).multiplyScalar(-high).add(this.at) : this.at, this.along, high, colours.friction);
    } else this.slide.hide();
    this.cone.visible = layers.cones && shown && this.contact.friction > 0;
    this.cone.position.copy(this.at);
    this.cone.quaternion.setFromUnitVectors(M.z, this.normal);
    this.cone.material.color.set(colours.friction);
    const state = mode === null ? (pulls ? "pulls" : "pushes") : ["open", "slips", "sticks"][mode];
    const dot = mode === null ? colour : [colours.open, colours.slip, colours.stick][mode];
    this.dot.visible = layers.forces && !now.hidden;
    this.dot.position.copy(this.at);
    this.dot.material.color.set(dot);
    this.dot.material.opacity = open ? 0.45 : 1;
    // Tangential force relative to the friction limit.
    const ratio = !open && this.contact.friction > 0 && force !== 0 ? slip / (this.contact.friction * Math.abs(force)) : null;
    Object.assign(this.state, { force, friction: slip, ratio, state, colour, shown, dot,
      length: shown ? this.push.head.position.z : 0, direction: shown ? (pulls ? -1 : 1) : 0 });
  }
};

// A joint below a surface: a ball that is drawn on top of bodies and floor.
M.Sunk = class {
  constructor(parent, point, size) {
    this.point = point;
    this.at = new THREE.Vector3();
    this.depth = null;
    this.mark = new THREE.Mesh(new THREE.SphereGeometry(0.11 * size, 16, 12), new THREE.MeshBasicMaterial({ ...M.above, opacity: 0.6 }));
    this.mark.renderOrder = 17;
    parent.add(this.mark);
  }

  // depth [m]; undefined if it is not below.
  show(body, depth, layers, colours) {
    this.depth = depth > this.point.least ? depth : null;
    this.mark.visible = layers.depths && this.depth !== null;
    this.at.set(...this.point.p).applyQuaternion(body.quaternion).add(body.position);
    this.mark.position.copy(this.at);
    this.colour = colours.sunk;
    this.mark.material.color.set(colours.sunk);
  }
};

// Points of a path with a minimum distance relative to its length: without a graphics card, wide lines with thousands
// of pieces take seconds to draw.
M.thinned = function (times, table, most = 360) {
  const [x, y, z] = [0, 1, 2].map((k) => table.column(k)), rows = [];
  for (let i = 0; i < times.length; i++) if (Number.isFinite(x[i] + y[i] + z[i])) rows.push(i);
  const way = (i, j) => Math.hypot(x[j] - x[i], y[j] - y[i], z[j] - z[i]);
  let length = 0;
  for (let k = 1; k < rows.length; k++) length += way(rows[k - 1], rows[k]);
  const kept = rows.slice(0, 1);
  let since = 0;
  for (let k = 1; k < rows.length; k++) {
    since += way(rows[k - 1], rows[k]);
    if (since < length / most && k < rows.length - 1) continue;
    kept.push(rows[k]);
    since = 0;
  }
  return { times: kept.map((i) => times[i]), points: kept.flatMap((i) => [x[i], y[i], z[i]]) };
};

// A path: faint, and bold up to the current time.
M.Path = class {
  constructor(parent, times, table, width, faint) {
    const path = M.thinned(times, table);
    this.times = path.times;
    this.whole = S.line(path.points, width);
    this.whole.material.opacity = faint;
    this.part = S.line(path.points, 1.6 * width);
    this.whole.renderOrder = this.part.renderOrder = 3;
    parent.add(this.whole, this.part);
  }

  show(t) {
    const done = this.times.length > 1 && t >= this.times[0] ? D.before(this.times, t) + 1 : 0;
    this.part.geometry.instanceCount = done;
    this.part.visible = this.shown && done > 0;
    this.whole.visible = this.shown;
  }
};

// A path that grows with live frames; when it is full, every second point is removed.
M.Growing = class {
  constructor(parent, most = 4000) {
    this.most = most;
    this.count = 0;
    this.points = new Float32Array(3 * most);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(this.points, 3));
    this.line = new THREE.Line(geometry, new THREE.LineBasicMaterial());
    this.line.frustumCulled = false;
    parent.add(this.line);
  }

  add(point) {
    if (this.count === this.most) {
      this.count = this.most >> 1;
      for (let i = 0; i < this.count; i++) for (let k = 0; k < 3; k++) this.points[3 * i + k] = this.points[6 * i + k];
    }
    point.toArray(this.points, 3 * this.count++);
    this.line.geometry.setDrawRange(0, this.count);
    this.line.geometry.attributes.position.needsUpdate = true;
  }
};

// The convex hull of points on the ground, and the point that must be inside.
M.Support = class {
  constructor(parent, most, size) {
    this.positions = new Float32Array(3 * 3 * Math.max(most, 3));
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(this.positions, 3));
    this.fill = new THREE.Mesh(geometry, new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.3, side: THREE.DoubleSide,
      depthWrite: false, polygonOffset: true, polygonOffsetFactor: -1, polygonOffsetUnits: -2 }));
    this.fill.frustumCulled = false;
    this.fill.renderOrder = -3;
    this.dot = new THREE.Mesh(new THREE.RingGeometry(0.05 * size, 0.09 * size, 24), new THREE.MeshBasicMaterial({ ...M.above,
      side: THREE.DoubleSide }));
    this.centre = new THREE.Mesh(new THREE.CircleGeometry(0.022 * size, 12), this.dot.material);
    this.dot.add(this.centre);
    this.dot.renderOrder = this.centre.renderOrder = 19;
    parent.add(this.fill, this.dot);
  }

  show(points, at, shown, colours) {
    const hull = M.hull(points);
    let n = 0;
    for (let k = 1; k + 1 < hull.length; k++)
      for (const p of [hull[0], hull[k], hull[k + 1]]) this.positions[n++] = p[0], this.positions[n++] = p[1], this.positions[n++] = 0.001;
    this.fill.geometry.setDrawRange(0, n / 3);
    this.fill.geometry.attributes.position.needsUpdate = true;
    this.fill.visible = shown && n > 0;
    this.fill.material.color.set(colours.support);
    this.inside = at && hull.length > 2 ? M.within(hull, at) : null;
    this.dot.visible = Boolean(shown && at);
    if (at) this.dot.position.set(at[0], at[1], 0.002);
    this.dot.material.color.set(this.inside === false ? colours.pull : colours.target);
    this.hull = hull;
  }
};

// Corners of the convex hull of points (x, y), counterclockwise.
M.hull = function (points) {
  const sorted = points.slice().sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const side = (list) => {
    const kept = [];
    for (const p of list) {
      while (kept.length > 1 && M.turn(kept[kept.length - 2], kept[kept.length - 1], p) <= 0) kept.pop();
      kept.push(p);
    }
    return kept.slice(0, -1);
  };
  return sorted.length < 3 ? sorted : [...side(sorted), ...side(sorted.reverse())];
};
M.turn = (a, b, c) => (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
M.within = (hull, p) => hull.every((a, k) => M.turn(a, hull[(k + 1) % hull.length], p) >= 0);
