"use strict";
// One robot in the scene. It shows samples from the tables of a record, or from live frames:
//   {time, poses: [x, y, z, w, x, y, z for each body], contacts: [{force, normal, tangent, mode}], wheels: [1 or 0],
//    depths: [m] of data.sunk, pressure: [x, y] or null, gripper: number of its state (0 is open), or null}

class Actor {
  constructor(data, bytes, meshes, index) {
    this.data = data;
    this.name = data.name;
    this.index = index;
    this.object = new THREE.Group();
    this.inner = new THREE.Group();
    this.object.add(this.inner);
    const table = (block) => new D.Table(bytes, block);
    this.times = table(data.frames).column(0);
    // Contacts, wheels and gripper change at other times than poses.
    this.instants = table(data.instants).column(0);
    this.position = table(data.position);
    this.orientation = table(data.orientation);
    this.size = Math.max(0.13 * data.reach, 3 * data.radius);
    this.contactTables = data.contacts.map((c) => ({ force: table(c.force), normal: table(c.normal),
      tangent: c.tangent && table(c.tangent), mode: c.mode && table(c.mode), at: c.at && table(c.at) }));
    this.depths = data.sunk.map((one) => table(one.depth));
    this.wheelTable = data.wheels && table(data.wheels.down);
    this.pressureTable = data.pressure && table(data.pressure.at);
    this.gripperTable = data.gripper && table(data.gripper);
    this.axes = Object.fromEntries(Object.entries(data.axes).map(([name, block]) => [name, table(block)]));
    this.signals = new Map(data.signals.map((s) => [s.name, { ...s, table: table(s.data) }]));
    this.span = [this.times[0], this.times[this.times.length - 1]];
    this.build(meshes);
    this.paths = Object.entries(data.paths).map(([kind, block]) => {
      const path = kind === "hand" ? new M.Path(this.inner, this.times, table(block), 1.6, 0.35) : null;
      if (path) return { kind, path };
      const { points } = M.thinned(this.times, table(block));
      const line = S.line(points, 1.5, 0.025 * data.reach);
      line.renderOrder = 4;
      this.inner.add(line);
      return { kind, line };
    });
    this.scale = this.contactTables.length
      ? Math.max(D.percentile(this.contactTables.flatMap((c) => Array.from(c.force.column(0), Math.abs)), 0.98), 1e-6) : 1;
    this.sample = this.emptySample();
  }

  emptySample() {
    return { time: 0, poses: new Float64Array(7 * this.bodies.length), wheels: (this.data.wheels?.names ?? []).map(() => 1),
      contacts: this.contacts.map(() => ({ force: NaN, normal: [0, 0, 1], tangent: [0, 0, 0], mode: null })),
      depths: [], pressure: this.pressureTable ? [0, 0] : null, gripper: null };
  }

  build(meshes) {
    const data = this.data;
    this.wheels = [];
    this.bodies = data.bodies.map((body) => {
      const group = new THREE.Group(), paint = [];
      for (const shape of body.shapes) {
        const own = shape.colour ? new THREE.Color().setRGB(...shape.colour) : null;
        const material = new THREE.MeshLambertMaterial();
        const mesh = new THREE.Mesh(S.geometry(shape, meshes), material);
        mesh.position.set(...shape.p);
        mesh.quaternion.set(...S.xyzw(shape.q));
        mesh.castShadow = mesh.receiveShadow = true;
        group.add(mesh);
        mesh.userData.text = shape.text ?? "";
        const role = shape.wheel !== undefined ? "wheel" : ["hub", "pad", "load"].includes(shape.role) ? shape.role : "body";
        const part = { mesh, material, own, role, alpha: shape.colour ? shape.colour[3] : 1, painted: !own && Boolean(mesh.geometry.attributes.color) };
        paint.push(part);
        if (role === "wheel") {
          // A mark that makes the rotation visible.
          const [radius, width] = shape.size;
          const spoke = new THREE.Mesh(new THREE.BoxGeometry(1.5 * radius, 0.22 * radius, 1.06 * width), new THREE.MeshBasicMaterial());
          mesh.add(spoke);
          part.spoke = spoke;
          this.wheels.push({ group: shape.wheel, part, body: group, rest: mesh.position.clone(), radius });
        }
      }
      this.inner.add(group);
      return { name: body.name, joint: body.joint, object: group, paint };
    });
    this.fixed = data.fixed.map((shape) => {
      const mesh = new THREE.Mesh(S.geometry(shape, meshes), new THREE.MeshLambertMaterial());
      mesh.position.set(...shape.p);
      mesh.quaternion.set(...S.xyzw(shape.q));
      mesh.castShadow = mesh.receiveShadow = true;
      this.inner.add(mesh);
      const own = shape.colour ? new THREE.Color().setRGB(...shape.colour) : null;
      if (!own && mesh.geometry.attributes.color) mesh.material.vertexColors = true;
      return { mesh, own: own ?? (mesh.material.vertexColors ? new THREE.Color(0xffffff) : null) };
    });
    this.contacts = data.contacts.map((contact) => new M.Contact(this.inner, contact, this.size));
    this.sunk = data.sunk.map((one) => new M.Sunk(this.inner, one, this.size));
    this.support = data.supports.length ? new M.Support(this.inner, data.supports.length, this.size) : null;
    this.supportPoint = new THREE.Vector3();
    if (data.hand) this.buildHand();
  }

  buildHand() {
    const size = Math.max(1.7 * this.data.radius, 0.012 * this.data.reach);
    this.handMaterial = new THREE.MeshBasicMaterial();
    this.hand = new THREE.Group();
    this.hand.position.set(...this.data.hand.p);
    this.bodies[this.data.hand.body]?.object.add(this.hand);
    if (!this.data.gripper) {
      this.hand.add(new THREE.Mesh(new THREE.SphereGeometry(0.75 * size, 16, 12), this.handMaterial));
      return;
    }
    // Two fingers in front of the controlled point, which open and close.
    this.fingers = [-1, 1].map((side) => {
      const finger = new THREE.Mesh(new THREE.BoxGeometry(...this.data.fingers.size), this.handMaterial);
      finger.userData = { side };
      this.hand.add(finger);
      return finger;
    });
  }

  // Sample of the record at a time: positions and orientations interpolated linearly, modes held.
  at(t) {
    this.live = false;
    const out = this.sample, n = this.bodies.length;
    const clipped = Math.min(Math.max(t, this.span[0]), this.span[1]);
    const between = (times) => {
      const i = times.length > 1 ? D.before(times, clipped) : 0, j = Math.min(i + 1, times.length - 1);
      const gap = times[j] - times[i], share = gap > 0 ? Math.min(Math.max(clipped - times[i], 0) / gap, 1) : 0;
      // Exactly at a frame, use this frame instead of the previous one.
      const held = share > 1 - 1e-9 ? j : i;
      return [(table, k) => { const c = table.column(k), a = c[i]; return share > 0 ? a + share * (c[j] - a) : a; }, held];
    };
    const [mix] = between(this.times), [force, held] = between(this.instants);
    out.time = clipped;
    for (let b = 0; b < n; b++) {
      for (let k = 0; k < 3; k++) out.poses[7 * b + k] = mix(this.position, 3 * b + k);
      for (let k = 0; k < 4; k++) out.poses[7 * b + 3 + k] = mix(this.orientation, 4 * b + k);
    }
    this.contactTables.forEach((c, m) => {
      const one = out.contacts[m];
      one.force = force(c.force, 0);
      one.mode = c.mode ? Math.round(c.mode.value(held, 0)) : null;
      one.at = c.at ? [0, 1, 2].map((k) => force(c.at, k)) : null;
      for (let k = 0; k < 3; k++) {
        one.normal[k] = force(c.normal, k);
        one.tangent[k] = c.tangent ? force(c.tangent, k) : 0;
      }
    });
    this.depths.forEach((one, k) => { out.depths[k] = mix(one, 0); });
    for (let k = 0; k < out.wheels.length; k++) out.wheels[k] = this.wheelTable ? Math.round(this.wheelTable.value(held, k)) : 1;
    if (this.pressureTable) out.pressure = [0, 1].map((k) => force(this.pressureTable, k));
    out.gripper = this.gripperTable ? Math.round(this.gripperTable.value(held, 0)) : null;
    return out;
  }

  // Show a sample.
  show(sample, layers, colours) {
    this.shown = sample;
    const poses = sample.poses;
    for (let b = 0; b < this.bodies.length; b++) {
      const o = 7 * b, object = this.bodies[b].object;
      if (!(poses[o] - poses[o] === 0)) continue;  // diverging run: keep the last pose
      object.position.set(poses[o], poses[o + 1], poses[o + 2]);
      object.quaternion.set(poses[o + 4], poses[o + 5], poses[o + 6], poses[o + 3]).normalize();
    }
    for (let k = 0; k < this.contacts.length; k++) {
      const contact = this.contacts[k];
      contact.show(this.bodies[contact.contact.body].object, sample.contacts[k], this.scale, layers, colours);
    }
    this.sunk.forEach((one, k) => one.show(this.bodies[one.point.body].object, sample.depths[k], layers, colours));
    for (const wheel of this.wheels) {
      const down = sample.wheels[wheel.group] > 0;
      if (wheel.down === down && wheel.colours === colours) continue;
      Object.assign(wheel, { down, colours });
      wheel.part.material.color.set(down ? colours.down : colours.lifted);
      wheel.part.spoke.material.color.set(down ? colours.lifted : colours.down);
      // The model has no height for a lifted wheel; it is drawn slightly above the ground.
      wheel.part.mesh.position.copy(wheel.rest);
      if (!down) wheel.part.mesh.position.z += 0.35 * wheel.radius;
    }
    if (this.support) this.support.show(this.supportPoints(sample), this.pressure(sample), layers.support, colours);
    if (this.fingers)
      for (const f of this.fingers) f.position.set(this.data.fingers.ahead, f.userData.side * this.data.fingers.aside[sample.gripper ? 1 : 0], 0);
    for (const one of this.paths) {
      if (one.line) one.line.visible = layers.target;
      else one.path.shown = layers.trace && !this.live, one.path.show(sample.time);
    }
    if (this.grown) this.grown.line.visible = Boolean(layers.trace && this.live);
  }

  // Live frame: extend the live path of the hand; the path of the record is hidden.
  extend(sample) {
    if (!this.hand) return;
    this.grown ??= new M.Growing(this.inner);
    this.grown.line.material.color.set(this.colours.hand);
    this.live = true;
    const body = this.data.hand.body, o = 7 * body, p = sample.poses, q = new THREE.Quaternion(p[o + 4], p[o + 5], p[o + 6], p[o + 3]);
    this.grown.add(this.supportPoint.set(...this.data.hand.p).applyQuaternion(q).add(new THREE.Vector3(p[o], p[o + 1], p[o + 2])));
  }

  supportPoints(sample) {
    const found = [];
    for (const support of this.data.supports) {
      if (support.group >= 0 && !(sample.wheels[support.group] > 0)) continue;
      const body = this.bodies[support.body].object;
      this.supportPoint.set(...support.p).applyQuaternion(body.quaternion).add(body.position);
      found.push([this.supportPoint.x, this.supportPoint.y]);
    }
    return found;
  }

  pressure(sample) {
    return sample.pressure && sample.pressure.every(Number.isFinite) ? sample.pressure : null;
  }

  handPosition(out) {
    if (!this.hand) return this.bodies[0].object.getWorldPosition(out);
    return this.hand.getWorldPosition(out);
  }

  // Posts from the floor to the joints that are fixed in the world.
  stand(floor) {
    for (const [x, y, z] of this.data.stands) {
      const high = z - floor - 1.5 * this.data.radius, radius = 1.2 * this.data.radius || 0.01 * this.data.reach;
      if (high < 2 * radius) continue;
      const post = new THREE.Mesh(new THREE.CylinderGeometry(radius, 1.6 * radius, high, 24).rotateX(Math.PI / 2), new THREE.MeshLambertMaterial());
      post.position.set(x, y, floor + 0.5 * high);
      post.castShadow = post.receiveShadow = true;
      this.inner.add(post);
      this.fixed.push({ mesh: post, own: null });
    }
  }

  // Prepare for solid surfaces: parts behind them are drawn again, as translucent silhouettes.
  seenBehind() {
    for (const part of this.bodies.flatMap((body) => body.paint)) {
      Object.assign(part.material, S.stencil(0));
      part.behind = new THREE.Mesh(part.mesh.geometry, new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.35, depthWrite: false,
        depthFunc: THREE.GreaterDepth, stencilWrite: true, stencilRef: 1, stencilFunc: THREE.EqualStencilFunc, stencilZPass: THREE.IncrementStencilOp }));
      part.behind.renderOrder = 2;
      part.mesh.add(part.behind);
    }
  }

  // Set the colours of the theme, of hubs (of everything for a translucent ghost), and of the hand path.
  dress(colours, tint, way, ghost) {
    this.colours = colours;
    this.tint = new THREE.Color(tint);
    this.ghost = ghost;
    this.marked = null;
    for (const body of this.bodies)
      for (const part of body.paint) {
        part.base = part.own ? part.own.clone() : new THREE.Color(part.painted ? 0xffffff : colours[part.role]);
        if (this.ghost) part.base = this.tint.clone();
        else if (!part.own && part.role === "hub") part.base.copy(this.tint);
        part.behind?.material.color.copy(part.base);
        part.material.transparent = ghost || part.alpha < 1;
        part.material.opacity = ghost ? 0.3 : part.alpha;
        part.material.depthWrite = !ghost;
        part.material.vertexColors = part.painted && !ghost;
        part.material.needsUpdate = true;
        if (part.role !== "wheel") part.material.color.copy(part.base);
      }
    for (const one of this.fixed) one.mesh.material.color.copy(one.own ?? new THREE.Color(colours.hub));
    for (const wheel of this.wheels) wheel.colours = null;
    if (this.handMaterial) this.handMaterial.color.set(tint);
    for (const one of this.paths) {
      if (one.line) one.line.material.color.set(colours.target);
      else for (const line of [one.path.whole, one.path.part]) line.material.color.set(way);
    }
  }

  // Colour the body that each motor moves, by body index; without colours, restore the theme.
  paint(colourOf) {
    this.bodies.forEach((body, k) => {
      const colour = colourOf ? colourOf.get(k) : null;
      for (const part of body.paint) {
        const motor = part.role === "body" || part.role === "hub";
        if (part.role !== "wheel") part.material.color.copy(motor && colourOf ? colour ?? this.plain : part.base);
        // Colours of motors replace the colours of a mesh file.
        const own = part.painted && !this.ghost && !colourOf;
        if (part.painted && part.material.vertexColors !== own) Object.assign(part.material, { vertexColors: own, needsUpdate: true });
      }
    });
  }

  // Hubs of motors at their voltage limit have a special colour.
  mark(saturated) {
    const key = saturated.join();
    if (key === this.marked) return;
    this.marked = key;
    const bodies = new Set(this.data.motors.filter(([name]) => saturated.includes(name)).map(([, body]) => body));
    this.bodies.forEach((body, k) => {
      for (const part of body.paint) if (part.role === "hub") part.material.emissive.set(bodies.has(k) ? this.colours.saturated : 0x000000);
    });
  }

  state() {
    return {
      name: this.name, time: this.shown.time,
      bodies: Object.fromEntries(this.bodies.map(({ name, object: o }) => [name,
        { p: o.position.toArray(), q: [o.quaternion.w, o.quaternion.x, o.quaternion.y, o.quaternion.z] }])),
      contacts: this.contacts.map((c) => ({ ...c.state, visible: c.push.object.visible })),
      sunk: Object.fromEntries(this.sunk.filter((one) => one.depth !== null).map((one) => [one.point.name, one.depth])),
      wheels: Object.fromEntries((this.data.wheels?.names ?? []).map((name, k) => [name, this.shown.wheels[k] > 0])),
      support: this.support && { corners: this.support.hull.length, inside: this.support.inside },
      hand: this.hand ? this.handPosition(new THREE.Vector3()).sub(this.object.position).toArray() : null,
      gripper: this.shown.gripper, saturated: this.saturated ?? [],
      offset: this.object.position.toArray(),
    };
  }
}
