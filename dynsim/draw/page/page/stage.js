"use strict";
// Renderer, camera, light and floor. Draws only after a change.

class Stage {
  // The box in which everything moves is rotated by the azimuth about z.
  constructor(canvas, azimuth, prepare) {
    this.prepare = prepare;
    this.azimuth = azimuth;
    this.canvas = canvas;
    // view.html#fine forces full quality (slow) without a graphics card.
    const software = Stage.software() && location.hash !== "#fine";
    this.renderer = new THREE.WebGLRenderer({ canvas, powerPreference: "high-performance", antialias: !software });
    this.software = software;
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(38, 1, 0.01, 100);
    this.camera.up.set(0, 0, 1);
    this.low = new THREE.Vector3();
    this.high = new THREE.Vector3();
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.touch());
    this.controls.addEventListener("start", () => { this.preset = null; });
    this.sky = new THREE.HemisphereLight(0xffffff, 0x9098a4, 0.62);
    this.sky.position.set(0, 0, 1);
    this.sun = new THREE.DirectionalLight(0xffffff, 0.62);
    this.scene.add(this.sky, this.sun, this.sun.target);
    this.shadows(!software);
    this.preset = "iso";
    this.changed = true;
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
  }

  // Whether the browser draws without a graphics card; smooth edges and shadows are then disabled.
  static software() {
    const gl = document.createElement("canvas").getContext("webgl");
    if (!gl) throw new Error("this browser has no WebGL, which 3D requires");
    const known = gl.getExtension("WEBGL_debug_renderer_info");
    const name = known ? gl.getParameter(known.UNMASKED_RENDERER_WEBGL) : "";
    gl.getExtension("WEBGL_lose_context")?.loseContext();
    return /swiftshader|llvmpipe|software|basic render/i.test(name);
  }

  shadows(on) {
    this.renderer.shadowMap.enabled = on;
    this.renderer.shadowMap.type = THREE.PCFSoftShadowMap;
    this.sun.castShadow = on;
  }

  // Adapt lights, floor and camera to the box in which everything moves.
  settle(low, high, floor) {
    this.low.copy(low);
    this.high.copy(high);
    const centre = this.centre(), span = low.distanceTo(high);
    this.sun.position.copy(centre).add(new THREE.Vector3(-0.45, -0.7, 1.3).multiplyScalar(span));
    this.sun.target.position.copy(centre);
    const eye = this.sun.shadow.camera;
    Object.assign(eye, { left: -0.7 * span, right: 0.7 * span, top: 0.7 * span, bottom: -0.7 * span, near: 0.1 * span, far: 4 * span });
    eye.updateProjectionMatrix();
    this.sun.shadow.mapSize.set(2048, 2048);
    this.sun.shadow.bias = -0.0005;
    if (this.floor) this.scene.remove(this.floor, this.shade);
    this.step = Stage.round(span / 12);
    this.floor = S.sheet(1.5 * span, this.step);
    // A grid that is not a surface of the scenario only helps to judge positions.
    this.floor.material.uniforms.strength.value = this.real ? 1 : 0.4;
    // Grid lines are at multiples of the step in the world.
    const at = (x) => Math.round(x / (5 * this.step)) * 5 * this.step;
    this.floor.position.set(at(centre.x), at(centre.y), floor);
    this.shade = new THREE.Mesh(new THREE.PlaneGeometry(3 * span, 3 * span), new THREE.ShadowMaterial({ opacity: 0.18 }));
    this.shade.position.set(centre.x, centre.y, floor + 1e-4 * span);
    this.shade.receiveShadow = true;
    this.shade.visible = this.real;
    this.scene.add(this.floor, this.shade);
    this.camera.near = 0.01 * span;
    this.camera.far = 30 * span;
    this.look(this.preset ?? "iso");
  }

  static round(x) {
    const power = 10 ** Math.floor(Math.log10(x));
    return [1, 2, 5, 10].map((m) => m * power).find((m) => m >= x * 0.999);
  }

  centre() {
    return this.turned(this.low.clone().add(this.high).multiplyScalar(0.5));
  }

  // From the frame of the box to the world.
  turned(point) {
    return point.applyAxisAngle(M.z, this.azimuth);
  }

  dress(colours) {
    this.colours = colours;
    this.scene.background = new THREE.Color(colours.fog);
    this.floor?.material.uniforms.ground.value.set(colours.ground);
    this.floor?.material.uniforms.lines.value.set(colours.gridline);
    this.touch();
  }

  // View from a direction, as close as the whole box fits into the window.
  look(preset) {
    this.preset = preset;
    // The longest extent of the robot, x before the rotation by the azimuth, is horizontal.
    // A row of variants is viewed more from the front; otherwise its end would be far away. Several rows are viewed from above.
    const from = { iso: this.rows ? [-0.3, -1, 1.1] : this.row ? [-0.22, -1, 0.42] : [-0.5, -1, 0.5], side: [0, -1, 0.06], front: [1, 0, 0.06], top: [0, -0.001, 1] }[preset];
    const back = this.turned(new THREE.Vector3(...from).normalize()), centre = this.centre();
    const right = new THREE.Vector3().crossVectors(this.camera.up, back).normalize();
    const up = new THREE.Vector3().crossVectors(back, right);
    const tan = Math.tan((this.camera.fov * Math.PI) / 360), aspect = this.camera.aspect;
    let distance = 0;
    for (let k = 0; k < 8; k++) {
      const corner = this.turned(new THREE.Vector3(k & 1 ? this.high.x : this.low.x, k & 2 ? this.high.y : this.low.y,
        k & 4 ? this.high.z : this.low.z)).sub(centre);
      const near = corner.dot(back);
      distance = Math.max(distance, near + Math.abs(corner.dot(up)) / tan, near + Math.abs(corner.dot(right)) / (tan * aspect));
    }
    this.controls.target.copy(centre);
    this.camera.position.copy(centre).addScaledVector(back, 1.06 * distance);
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.touch();
  }

  // Move with a point at constant distance.
  follow(point) {
    const step = point.clone().sub(this.controls.target);
    this.controls.target.add(step);
    this.camera.position.add(step);
    this.controls.update();
  }

  resize() {
    const box = this.canvas.parentElement.getBoundingClientRect();
    const width = Math.max(box.width, 1), height = Math.max(box.height, 1);
    this.renderer.setPixelRatio(this.software ? 1 : Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.size = [width, height];
    this.scene.traverse((one) => one.material?.isLineMaterial && one.material.resolution.set(width, height));
    if (this.preset && this.floor) this.look(this.preset);
    this.touch();
  }

  touch() {
    this.changed = true;
  }

  // Position of a world point in the window; null behind the camera.
  project(point, out) {
    out.copy(point).project(this.camera);
    return out.z > 1 ? null : [(0.5 + 0.5 * out.x) * this.size[0], (0.5 - 0.5 * out.y) * this.size[1]];
  }

  draw() {
    this.changed = false;
    this.prepare(this.camera);
    this.renderer.render(this.scene, this.camera);
  }
}
