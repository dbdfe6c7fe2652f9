"use strict";
// Geometry of shapes, surfaces and marks; round shapes are along z.
const S = {};

S.geometry = function (shape, meshes) {
  const [a, b, c] = shape.size;
  switch (shape.kind) {
    case "box": return new THREE.BoxGeometry(a, b, c);
    case "sphere": return new THREE.SphereGeometry(a, 24, 16);
    case "cylinder": return new THREE.CylinderGeometry(a, a, b, 28).rotateX(Math.PI / 2);
    case "capsule": return S.capsule(a, b);
    case "mesh": return meshes[shape.mesh].clone().scale(a, b, c);
  }
  throw new Error("unknown shape " + shape.kind);
};

S.capsule = function (radius, length) {
  const profile = [], steps = 8;
  for (const side of [-1, 1])
    for (let k = 0; k <= steps; k++) {
      const angle = (side < 0 ? steps - k : k) / steps * Math.PI / 2;
      profile.push(new THREE.Vector2(Math.max(radius * Math.cos(angle), 1e-9), side * (0.5 * length + radius * Math.sin(angle))));
    }
  return new THREE.LatheGeometry(profile, 24).rotateX(Math.PI / 2);
};

// Triangles with 16-bit corners in a box: {vertices, triangles, low, step}. Edges of more than 40° remain sharp.
S.mesh = function (bytes, mesh) {
  const codes = ({ at, count, bits }) => new (bits === 16 ? Uint16Array : Uint32Array)(bytes.slice(at, at + (bits / 8) * count).buffer);
  const raw = codes(mesh.vertices), corner = codes(mesh.triangles), faces = corner.length / 3;
  const at = (i, k) => mesh.low[k] + mesh.step[k] * raw[3 * i + k];
  const normals = new Float32Array(corner.length), around = new Map();
  for (let f = 0; f < faces; f++) {
    const [a, b, c] = [0, 1, 2].map((j) => corner[3 * f + j]);
    const u = [0, 1, 2].map((k) => at(b, k) - at(a, k)), v = [0, 1, 2].map((k) => at(c, k) - at(a, k));
    for (let k = 0; k < 3; k++) normals[3 * f + k] = u[(k + 1) % 3] * v[(k + 2) % 3] - u[(k + 2) % 3] * v[(k + 1) % 3];
    for (const i of [a, b, c]) around.has(i) ? around.get(i).push(f) : around.set(i, [f]);
  }
  const positions = new Float32Array(9 * faces), smooth = new Float32Array(9 * faces);
  const dot = (f, g) => normals[3 * f] * normals[3 * g] + normals[3 * f + 1] * normals[3 * g + 1] + normals[3 * f + 2] * normals[3 * g + 2];
  for (let f = 0; f < faces; f++)
    for (let j = 0; j < 3; j++) {
      const i = corner[3 * f + j], o = 9 * f + 3 * j, own = Math.sqrt(dot(f, f)), sum = [0, 0, 0];
      for (const g of around.get(i)) if (dot(f, g) >= 0.766 * own * Math.sqrt(dot(g, g))) for (let k = 0; k < 3; k++) sum[k] += normals[3 * g + k];
      const size = Math.hypot(...sum) || 1;
      for (let k = 0; k < 3; k++) positions[o + k] = at(i, k), smooth[o + k] = sum[k] / size;
    }
  const made = new THREE.BufferGeometry();
  made.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  made.setAttribute("normal", new THREE.BufferAttribute(smooth, 3));
  if (mesh.palette) {
    // Colours of the file; grey if there is no colour.
    const paint = codes(mesh.paint), colours = new Float32Array(9 * faces);
    for (let f = 0; f < faces; f++) for (let j = 0; j < 9; j++) colours[9 * f + j] = (mesh.palette[paint[f]] ?? [0.68, 0.72, 0.77])[j % 3];
    made.setAttribute("color", new THREE.BufferAttribute(colours, 3));
  }
  return made;
};

// A floor with a grid that fades towards its edge.
S.sheet = function (half, step) {
  const uniforms = { ground: { value: new THREE.Color() }, lines: { value: new THREE.Color() }, extent: { value: half },
    cell: { value: step }, strength: { value: 1 } };
  const material = new THREE.ShaderMaterial({
    uniforms, transparent: true, side: THREE.DoubleSide, depthWrite: false, extensions: { derivatives: true },
    polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 4,
    vertexShader: `varying vec2 at; void main() { at = position.xy;
      gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`,
    fragmentShader: `varying vec2 at; uniform vec3 ground, lines; uniform float extent, cell, strength;
      float line(vec2 x, float wide) { vec2 w = fwidth(x); vec2 d = abs(fract(x - 0.5) - 0.5) / w;
        float a = 1.0 - min(min(d.x, d.y) / wide, 1.0); return a * (1.0 - smoothstep(0.15, 0.5, max(w.x, w.y))); }
      void main() { float fade = 1.0 - smoothstep(0.45, 1.0, length(at) / extent);
        float rule = max(0.55 * line(at / cell, 1.1), line(at / (5.0 * cell), 1.4));
        gl_FragColor = vec4(mix(ground, lines, rule), fade * strength * (0.55 + 0.45 * rule)); }`,
  });
  const made = new THREE.Mesh(new THREE.PlaneGeometry(2 * half, 2 * half), material);
  made.renderOrder = -10;
  return made;
};

S.grid = function (surface) {
  const { rows, columns, points } = surface, at = (i, j) => 3 * (i * columns + j), index = [];
  const known = (i, j) => points[at(i, j)] !== null;
  for (let i = 0; i + 1 < rows; i++)
    for (let j = 0; j + 1 < columns; j++)
      if (known(i, j) && known(i + 1, j) && known(i, j + 1) && known(i + 1, j + 1)) {
        const a = i * columns + j;
        index.push(a, a + 1, a + columns, a + 1, a + columns + 1, a + columns);
      }
  const made = new THREE.BufferGeometry();
  made.setAttribute("position", new THREE.Float32BufferAttribute(points.map((x) => x ?? 0), 3));
  made.setIndex(index);
  made.computeVertexNormals();
  return made;
};

// Stencil that marks whether a surface (1) or something else (0) is in front.
S.stencil = (ref) => ({ stencilWrite: true, stencilRef: ref, stencilZPass: THREE.ReplaceStencilOp });

// A plane as a slab of some thickness below it, which ends at the floor.
S.slab = function ({ p, q, size }, thick, floor) {
  const up = new THREE.Vector3(0, 1, 0).applyQuaternion(new THREE.Quaternion(...S.xyzw(q))).z;
  const low = up > 0.05 ? Math.min(Math.max(-0.5 * size[1], (floor - p[2]) / up), 0.4 * size[1]) : -0.5 * size[1];
  return new THREE.BoxGeometry(size[0], 0.5 * size[1] - low, thick).translate(0, 0.5 * (0.5 * size[1] + low), -0.5 * thick);
};

// A surface other than the floor. From a surface that surrounds the robot only the far side is drawn.
S.surface = function (surface, thick, floor) {
  const hollow = surface.radius < 0, grid = surface.kind === "grid";
  const geometry = {
    plane: () => S.slab(surface, thick, floor),
    sphere: () => new THREE.SphereGeometry(Math.abs(surface.radius), 48, 32).rotateX(Math.PI / 2),
    cylinder: () => new THREE.CylinderGeometry(Math.abs(surface.radius), Math.abs(surface.radius), surface.length, 64, 1, hollow)
      .rotateX(Math.PI / 2),
    box: () => new THREE.BoxGeometry(...surface.size),
    grid: () => S.grid(surface),
  }[surface.kind]();
  const material = new THREE.MeshLambertMaterial({ side: grid ? THREE.DoubleSide : hollow ? THREE.BackSide : THREE.FrontSide,
    polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 2, ...S.stencil(1) });
  const made = new THREE.Mesh(geometry, material);
  // Edges make a solid of one colour visible.
  made.add(new THREE.LineSegments(grid ? S.ruled(surface) : new THREE.EdgesGeometry(geometry, 30),
    new THREE.LineBasicMaterial({ transparent: true, opacity: 0.55 })));
  if (surface.q) made.quaternion.set(...S.xyzw(surface.q));
  if (surface.p) made.position.set(...surface.p);
  return made;
};

// Lines of a grid of points, about ten in each direction, and its border.
S.ruled = function ({ rows, columns, points }) {
  const found = [], step = Math.max(1, Math.round(Math.max(rows, columns) / 20)), on = (k, n) => k % step === 0 || k === n - 1;
  const add = (a, b) => { if (points[3 * a] !== null && points[3 * b] !== null) found.push(...points.slice(3 * a, 3 * a + 3), ...points.slice(3 * b, 3 * b + 3)); };
  for (let i = 0; i < rows; i++)
    for (let j = 0; j < columns; j++) {
      if (on(i, rows) && j + 1 < columns) add(i * columns + j, i * columns + j + 1);
      if (on(j, columns) && i + 1 < rows) add(i * columns + j, (i + 1) * columns + j);
    }
  const made = new THREE.BufferGeometry();
  made.setAttribute("position", new THREE.Float32BufferAttribute(found, 3));
  return made;
};

// A wall between the viewer and the robot is drawn translucent.
S.face = function (made, camera) {
  const { surface, normal } = made.userData, material = made.material;
  const back = surface.kind === "plane" && made.getWorldPosition(new THREE.Vector3()).sub(camera.position).dot(normal) > 0;
  if (material.transparent === back) return;
  Object.assign(material, { transparent: back, opacity: back ? 0.25 : 1, depthWrite: !back, needsUpdate: true });
};

S.paint = function (made, colours) {
  made.material.color.set(colours.solid);
  // Light from above hardly reaches walls.
  const { surface, normal } = made.userData;
  made.material.emissive.set(colours.solid).multiplyScalar(surface.kind === "plane" ? 0.3 * (1 - Math.abs(normal.z)) : 0);
  for (const edges of made.children) edges.material.color.set(colours.edge);
};

// Extent of a surface along a unit vector; a plane is infinite and has no extent.
S.extent = function (made, way) {
  const { surface } = made.userData, at = made.position.dot(way);
  const across = (k) => Math.abs(new THREE.Vector3().setComponent(k, 1).applyQuaternion(made.quaternion).dot(way));
  switch (surface.kind) {
    case "sphere": return [at - Math.abs(surface.radius), at + Math.abs(surface.radius)];
    case "cylinder": {
      const half = 0.5 * surface.length * across(2) + Math.abs(surface.radius) * Math.sqrt(Math.max(1 - across(2) ** 2, 0));
      return [at - half, at + half];
    }
    case "box": {
      const half = surface.size.reduce((sum, edge, k) => sum + 0.5 * edge * across(k), 0);
      return [at - half, at + half];
    }
    case "grid": {
      let low = Infinity, high = -Infinity;
      for (let i = 0; i < surface.points.length; i += 3) {
        if (surface.points[i] === null) continue;
        const x = surface.points[i] * way.x + surface.points[i + 1] * way.y + surface.points[i + 2] * way.z;
        low = Math.min(low, x), high = Math.max(high, x);
      }
      return low <= high ? [low, high] : [];
    }
  }
  return [];
};

S.xyzw = (q) => [q[1], q[2], q[3], q[0]];

// A wide line through points (flat array of numbers).
S.line = function (points, width, dashed) {
  const geometry = new THREE.LineGeometry();
  geometry.setPositions(points);
  const material = new THREE.LineMaterial({ linewidth: width, dashed: Boolean(dashed), transparent: true });
  if (dashed) Object.assign(material, { dashSize: dashed, gapSize: 0.7 * dashed, dashScale: 1 });
  const made = new THREE.Line2(geometry, material);
  if (dashed) made.computeLineDistances();
  made.frustumCulled = false;
  return made;
};
