// One WebGL context, several viewports (scissor), linked cameras.  Draws only when something changed.
import * as THREE from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import { Arrows, Layer, Shared } from "./layers.js";

const STILL = 180; // ms without change after which a smoother picture is drawn
const SMOOTH = 4; // samples a pixel of that picture

export class NoWebGL extends Error {}

export class Stage {
  constructor(host, store) {
    this.host = host;
    this.canvas = document.createElement("canvas");
    this.canvas.style.cssText = "display:block;touch-action:none;outline:none";
    const context = this.canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!context) throw new NoWebGL("this browser gives no WebGL 2 context");
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, context, antialias: false });
    this.renderer.autoClear = false;
    this.renderer.setScissorTest(true);
    this.ratio = Math.min(globalThis.devicePixelRatio || 1, 2);
    this.renderer.setPixelRatio(this.ratio);
    host.prepend(this.canvas);
    this.drawn = 0;
    this.frame = 0;
    this.dirty = true;
    this.alive = true;
    this.afterDraw = () => {};
    this.build(store);
    this.loop = this.loop.bind(this);
    requestAnimationFrame(this.loop);
  }

  build(store) {
    this.store = store;
    store.pixelRatio = this.ratio;
    const header = store.header;
    this.shared = new Shared(store);
    this.background = new THREE.Color().setRGB(...header.background, THREE.LinearSRGBColorSpace);
    const linked = this.rig(header.camera);
    this.rigs = [linked];
    this.views = header.views.map((view) => {
      const scene = new THREE.Scene();
      const layers = view.layers.map((described) =>
        new (described.kind === "arrows" ? Arrows : Layer)(store, this.shared, described));
      for (const layer of layers) scene.add(layer.group);
      let rig = linked;
      if (view.camera) this.rigs.push((rig = this.rig(view.camera)));
      return { scene, layers, rig, title: view.title };
    });
    this.columns = header.columns;
    this.rows = Math.ceil(this.views.length / this.columns);
    this.pin = pinOf();
    this.canvas.addEventListener("pointerdown", (this.route = (event) => this.steer(event)), true);
    this.canvas.addEventListener("wheel", this.route, { capture: true, passive: true });
    this.showFrame(0);
  }

  /** A camera with its controls. */
  rig(described) {
    const camera = new THREE.PerspectiveCamera(described.angle, 1, 0.01, 200);
    camera.up.set(...described.up);
    const controls = new OrbitControls(camera, this.canvas);
    const home = () => {
      camera.up.set(...described.up);
      camera.position.set(...described.position);
      controls.target.set(...described.target);
      controls.update();
      this.dirty = true;
    };
    controls.addEventListener("change", () => (this.dirty = true));
    controls.zoomSpeed = 0.8;
    const rig = { camera, controls, home };
    home();
    return rig;
  }

  /** The pointer turns the camera of the view that it is in. */
  steer(event) {
    const view = this.viewAt(event);
    for (const rig of this.rigs) rig.controls.enabled = !view || rig === view.rig;
  }

  resize(width, height) {
    if (width === this.width && height === this.height) return;
    [this.width, this.height] = [width, height];
    this.renderer.setSize(width, height);
    this.target?.dispose();
    this.target = null;
    this.dirty = true;
  }

  /** Left, top, width, height of a view in CSS pixels. */
  box(index) {
    const w = this.width / this.columns, h = this.height / this.rows;
    return [(index % this.columns) * w, Math.floor(index / this.columns) * h, w, h];
  }

  viewAt(event) {
    const place = this.canvas.getBoundingClientRect();
    const column = Math.floor(((event.clientX - place.left) / place.width) * this.columns);
    const row = Math.floor(((event.clientY - place.top) / place.height) * this.rows);
    return this.views[row * this.columns + column];
  }

  get layers() {
    return this.views.flatMap((view) => view.layers);
  }

  named(name) {
    return this.layers.filter((layer) => layer.name === name);
  }

  showFrame(frame) {
    this.frame = frame;
    this.shared.show(frame);
    for (const layer of this.layers) layer.show(frame);
    if (this.pinned) this.pinAt(this.pinned.layer, this.pinned.vertex);
    this.dirty = true;
  }

  /** New arrays for the same structure. */
  renew(store) {
    this.store.header = store.header;
    for (const [v, view] of this.views.entries())
      for (const [l, layer] of view.layers.entries()) layer.update(store.header.views[v].layers[l]);
    this.showFrame(this.frame);
  }

  loop(now) {
    if (!this.alive) return;
    requestAnimationFrame(this.loop);
    this.tick?.(now);
    if (this.dirty) {
      this.dirty = false;
      this.changed = now;
      this.smoothed = false;
      this.draw(null);
      this.drawn++;
      this.afterDraw();
    } else if (!this.smoothed && now - this.changed > STILL) {
      this.smoothed = true;
      this.drawSmooth();
    }
  }

  draw(target) {
    if (!this.width) return;
    const renderer = this.renderer;
    renderer.setRenderTarget(target);
    const scale = target ? this.ratio : 1; // a target is measured in pixels, the canvas in CSS pixels
    this.views.forEach((view, index) => {
      const [left, top, width, height] = this.box(index);
      const area = [left, this.height - top - height, width, height].map((x) => x * scale);
      if (target) {
        target.viewport.set(...area);
        target.scissor.set(...area);
        target.scissorTest = true;
        renderer.setRenderTarget(target);
      } else {
        renderer.setViewport(...area);
        renderer.setScissor(...area);
      }
      const { camera, controls } = view.rig;
      camera.aspect = width / height;
      const distance = camera.position.distanceTo(controls.target);
      camera.near = Math.max(distance / 200, 1e-3);
      camera.far = distance * 20 + 20;
      camera.updateProjectionMatrix();
      renderer.setClearColor(this.background, 1);
      renderer.clear();
      renderer.render(view.scene, camera);
      if (this.pinned && view.layers.includes(this.pinned.layer)) renderer.render(this.pin, camera);
    });
    renderer.setRenderTarget(null);
  }

  /** The same picture without jagged edges: too slow for motion, right for a picture that stands still. */
  drawSmooth() {
    if (!this.width) return;
    const [width, height] = [this.width, this.height].map((x) => Math.round(x * this.ratio));
    this.target ??= new THREE.WebGLRenderTarget(width, height, { samples: SMOOTH });
    this.draw(this.target);
    this.copy ??= copier();
    this.copy.material.uniforms.picture.value = this.target.texture;
    this.renderer.setViewport(0, 0, this.width, this.height);
    this.renderer.setScissor(0, 0, this.width, this.height);
    this.renderer.render(this.copy, new THREE.Camera());
  }

  /** The nearest vertex under the pointer, as {layer, vertex}, or null. */
  pick(event) {
    const index = this.views.indexOf(this.viewAt(event));
    if (index < 0) return null;
    const [left, top, width, height] = this.box(index), view = this.views[index];
    const place = this.canvas.getBoundingClientRect();
    const x = ((event.clientX - place.left - left) / width) * 2 - 1;
    const y = 1 - ((event.clientY - place.top - top) / height) * 2;
    const camera = view.rig.camera;
    camera.aspect = width / height;
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
    const ray = new THREE.Ray(), end = new THREE.Vector3(x, y, 0.5).unproject(camera);
    ray.origin.copy(camera.position);
    ray.direction.copy(end).sub(camera.position).normalize();
    let best = null;
    for (const layer of view.layers) {
      if (!layer.shown || layer instanceof Arrows) continue;
      const hit = layer.positions.faces && !layer.ghost ? hitFaces(layer, ray) : null;
      const seen = hit ?? hitDots(layer, ray, camera, height);
      if (seen && (!best || seen.distance < best.distance)) best = { layer, ...seen };
    }
    return best;
  }

  pinAt(layer, vertex) {
    this.pinned = { layer, vertex };
    this.pin.children[0].position.fromArray(layer.positions.attribute.array, 3 * vertex);
    this.dirty = true;
  }

  /** Look from outside at a vertex, `reach` metres around it. */
  lookAt(layer, vertex, reach) {
    const view = this.views.find((one) => one.layers.includes(layer)), { camera, controls } = view.rig;
    const away = reach / Math.tan((camera.fov * Math.PI) / 360), normals = layer.positions.normals;
    controls.target.fromArray(layer.positions.attribute.array, 3 * vertex);
    const outwards = normals ? new THREE.Vector3().fromArray(normals.array, 3 * vertex) : new THREE.Vector3();
    if (!(outwards.length() > 0.5)) outwards.copy(camera.position).sub(controls.target).normalize();
    camera.position.copy(controls.target).addScaledVector(outwards, away);
    controls.update();
    this.dirty = true;
  }

  unpin() {
    this.pinned = null;
    this.dirty = true;
  }

  png() {
    this.drawSmooth();
    return this.canvas.toDataURL("image/png");
  }

  clear() {
    this.canvas.removeEventListener("pointerdown", this.route, true);
    this.canvas.removeEventListener("wheel", this.route, true);
    for (const layer of this.layers) layer.dispose();
    for (const rig of this.rigs) rig.controls.dispose();
    this.pinned = null;
  }

  dispose() {
    this.alive = false;
    this.clear();
    this.target?.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss(); // browsers keep some 16 contexts, and take the oldest away
    this.canvas.remove();
  }
}

/** Moeller-Trumbore over all faces, then the nearest corner. */
function hitFaces(layer, ray) {
  const p = layer.positions.attribute.array, f = layer.positions.faces, { origin: o, direction: d } = ray;
  let nearest = Infinity, face = -1;
  const labels = layer.labels.array;
  for (let i = 0; i < f.length; i += 3) {
    const a = 3 * f[i], b = 3 * f[i + 1], c = 3 * f[i + 2];
    const e1x = p[b] - p[a], e1y = p[b + 1] - p[a + 1], e1z = p[b + 2] - p[a + 2];
    const e2x = p[c] - p[a], e2y = p[c + 1] - p[a + 1], e2z = p[c + 2] - p[a + 2];
    const hx = d.y * e2z - d.z * e2y, hy = d.z * e2x - d.x * e2z, hz = d.x * e2y - d.y * e2x;
    const det = e1x * hx + e1y * hy + e1z * hz;
    if (Math.abs(det) < 1e-14) continue;
    const sx = o.x - p[a], sy = o.y - p[a + 1], sz = o.z - p[a + 2];
    const u = (sx * hx + sy * hy + sz * hz) / det;
    if (u < 0 || u > 1) continue;
    const qx = sy * e1z - sz * e1y, qy = sz * e1x - sx * e1z, qz = sx * e1y - sy * e1x;
    const v = (d.x * qx + d.y * qy + d.z * qz) / det;
    if (v < 0 || u + v > 1) continue;
    const t = (e2x * qx + e2y * qy + e2z * qz) / det;
    if (t > 1e-6 && t < nearest && (layer.region < 0 || labels[f[i]] === layer.region)) [nearest, face] = [t, i];
  }
  if (face < 0) return null;
  const at = [o.x + d.x * nearest, o.y + d.y * nearest, o.z + d.z * nearest];
  let vertex = f[face], least = Infinity;
  for (let k = 0; k < 3; k++) {
    const v = f[face + k], away = Math.hypot(p[3 * v] - at[0], p[3 * v + 1] - at[1], p[3 * v + 2] - at[2]);
    if (away < least) [least, vertex] = [away, v];
  }
  return { vertex, face: face / 3, distance: nearest };
}

/** The vertex whose dot is nearest to the ray, within eight pixels; of a surface that is not ghosted, only marked ones. */
function hitDots(layer, ray, camera, height) {
  if (layer.described.kind === "mesh") return null;
  const p = layer.positions.attribute.array, v = new THREE.Vector3(), near = new THREE.Vector3();
  const pixel = (2 * Math.tan((camera.fov * Math.PI) / 360)) / height;
  let best = null, least = 8;
  for (let i = 0; i < layer.count; i++) {
    v.fromArray(p, 3 * i);
    const distance = near.copy(v).sub(ray.origin).dot(ray.direction);
    if (distance <= 0) continue;
    const away = ray.distanceToPoint(v) / (pixel * distance);
    if (away < least) {
      least = away;
      best = { vertex: i, distance };
    }
  }
  return best;
}

/** A ring around the vertex that is read. */
function pinOf() {
  const scene = new THREE.Scene();
  const ring = new THREE.Sprite(new THREE.SpriteMaterial({
    map: ringTexture(), sizeAttenuation: false, depthTest: false }));
  ring.scale.set(0.035, 0.035, 1);
  scene.add(ring);
  return scene;
}

function ringTexture() {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 64;
  const pen = canvas.getContext("2d");
  for (const [colour, width] of [["#fff", 12], ["#111", 6]]) {
    pen.strokeStyle = colour;
    pen.lineWidth = width;
    pen.beginPath();
    pen.arc(32, 32, 22, 0, 7);
    pen.stroke();
  }
  return new THREE.CanvasTexture(canvas);
}

function copier() {
  const scene = new THREE.Scene();
  const square = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), new THREE.RawShaderMaterial({
    glslVersion: THREE.GLSL3, depthTest: false, depthWrite: false, uniforms: { picture: { value: null } },
    vertexShader: "in vec3 position; out vec2 at; void main() { at = position.xy * 0.5 + 0.5; gl_Position = vec4(position, 1.0); }",
    fragmentShader: "precision highp float; uniform sampler2D picture; in vec2 at; out vec4 pixel;" +
      "void main() { pixel = vec4(texture(picture, at).rgb, 1.0); }",
  }));
  square.frustumCulled = false;
  scene.add(square);
  scene.material = square.material;
  return scene;
}
