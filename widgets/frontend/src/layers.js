// Layers of a scene as three.js objects.  Each reads its frame out of the store; nothing else knows the wire format.
import * as THREE from "three";
import * as glsl from "./shaders.js";

const NAN = 65535;
const WARNING = [0.95, 0.0, 0.45];
const EMPTY = -1e30; // a value that is NaN

/** Positions of one moving array as floats, with normals; shared by the layers that show it. */
class Positions {
  constructor(store, described, facesKey) {
    this.store = store;
    this.key = described.key;
    [this.frames, this.count] = store.header.arrays[this.key].shape;
    this.described = described;
    this.faces = facesKey ? store.arrays[facesKey] : null;
    this.attribute = new THREE.BufferAttribute(new Float32Array(this.count * 3), 3);
    this.normals = this.faces ? new THREE.BufferAttribute(new Float32Array(this.count * 3), 3) : null;
    this.broken = null; // which vertices are NaN in this frame, or null
    this.shown = -1;
  }

  update(described) {
    this.described = described;
    this.shown = -1;
  }

  show(frame) {
    const t = this.frames > 1 ? frame : 0;
    if (t === this.shown) return;
    this.shown = t;
    const codes = this.store.arrays[this.key], [x, y, z] = this.described.low, step = this.described.step;
    const out = this.attribute.array, start = t * this.count * 3;
    this.broken = null;
    for (let i = 0; i < this.count * 3; i += 3) {
      const a = codes[start + i];
      if (a === NAN || codes[start + i + 1] === NAN || codes[start + i + 2] === NAN) {
        this.broken ??= new Uint8Array(this.count);
        this.broken[i / 3] = 1;
        out[i] = x; out[i + 1] = y; out[i + 2] = z;
        continue;
      }
      out[i] = x + step * a;
      out[i + 1] = y + step * codes[start + i + 1];
      out[i + 2] = z + step * codes[start + i + 2];
    }
    this.attribute.needsUpdate = true;
    if (this.faces) this.turn();
  }

  /** Vertex normals, weighted by area. */
  turn() {
    const p = this.attribute.array, n = this.normals.array, f = this.faces;
    n.fill(0);
    for (let i = 0; i < f.length; i += 3) {
      const a = 3 * f[i], b = 3 * f[i + 1], c = 3 * f[i + 2];
      const ux = p[b] - p[a], uy = p[b + 1] - p[a + 1], uz = p[b + 2] - p[a + 2];
      const vx = p[c] - p[a], vy = p[c + 1] - p[a + 1], vz = p[c + 2] - p[a + 2];
      const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
      n[a] += x; n[a + 1] += y; n[a + 2] += z;
      n[b] += x; n[b + 1] += y; n[b + 2] += z;
      n[c] += x; n[c + 1] += y; n[c + 2] += z;
    }
    for (let i = 0; i < n.length; i += 3) {
      const length = Math.hypot(n[i], n[i + 1], n[i + 2]) || 1;
      n[i] /= length; n[i + 1] /= length; n[i + 2] /= length;
    }
    this.normals.needsUpdate = true;
  }
}

/** The positions that a header names, each once. */
export class Shared {
  constructor(store) {
    this.store = store;
    this.positions = new Map();
  }

  of(described, facesKey) {
    const key = `${described.key}|${facesKey ?? ""}`;
    if (!this.positions.has(key)) this.positions.set(key, new Positions(this.store, described, facesKey));
    return this.positions.get(key);
  }

  show(frame) {
    for (const positions of this.positions.values()) positions.show(frame);
  }
}

const material = (vertexShader, fragmentShader, uniforms, more = {}) =>
  new THREE.RawShaderMaterial({ glslVersion: THREE.GLSL3, vertexShader, fragmentShader, uniforms, ...more });

/** A layer that has vertices with numbers: a mesh, dots or surfels. */
export class Layer {
  constructor(store, shared, described) {
    this.store = store;
    this.described = described;
    this.name = described.name;
    this.positions = shared.of(described.positions, described.faces);
    this.count = this.positions.count;
    this.group = new THREE.Group();
    this.choice = described.plain || !described.scalars?.length ? -1 : 0;
    this.shown = true;
    this.ghost = (described.opacity ?? 1) < 1;
    this.region = -1;
    this.value = new THREE.BufferAttribute(new Float32Array(this.count), 1);
    this.state = new THREE.BufferAttribute(new Float32Array(this.count), 1);
    this.labels = new THREE.BufferAttribute(new Float32Array(this.count).fill(-1), 1);
    if (described.regions) this.labels.array.set(store.arrays[described.regions.key]);
    this.uniforms = {
      map: { value: null }, limits: { value: new THREE.Vector2(0, 1) }, steps: { value: 256 },
      plain: { value: new THREE.Vector3(...described.colour) }, painted: { value: 0 }, isolated: { value: -1 },
      opacity: { value: 1 }, flatness: { value: 0 }, faceted: { value: described.smooth === false ? 1 : 0 },
      warning: { value: new THREE.Vector3(...WARNING) },
    };
    this.build();
    this.choose(this.choice);
    this.setGhost(this.ghost);
  }

  get scalars() {
    return this.choice < 0 ? null : this.described.scalars[this.choice];
  }

  build() {
    const d = this.described;
    this.geometry = new THREE.BufferGeometry();
    if (d.kind === "points" && d.normals) this.buildSurfels();
    else {
      this.geometry.setAttribute("position", this.positions.attribute);
      this.geometry.setAttribute("value", this.value);
      this.geometry.setAttribute("state", this.state);
      this.geometry.setAttribute("region", this.labels);
      if (d.kind === "mesh") this.buildSurface();
      else this.buildDots();
    }
    if (d.marks) {
      // marked vertices are seen through whatever lies in front
      const marked = material(glsl.dotVertex, glsl.dotFragment, {
        ...this.uniforms, plain: this.uniforms.warning, size: { value: 6 * this.ratio }, only: { value: 1 },
      }, { depthTest: false, depthWrite: false });
      this.marked = new THREE.Points(this.dots ?? this.geometry, marked);
      this.marked.renderOrder = 100;
      this.add(this.marked);
    }
  }

  buildSurface() {
    this.geometry.setAttribute("normal", this.positions.normals);
    this.geometry.setIndex(new THREE.BufferAttribute(this.positions.faces, 1));
    const side = { side: THREE.DoubleSide };
    this.solid = new THREE.Mesh(this.geometry, material(glsl.meshVertex, glsl.meshFragment, this.uniforms, side));
    // a ghost is drawn where its nearest sheet is: first depth alone, then colour
    this.depth = new THREE.Mesh(
      this.geometry, material(glsl.meshVertex, glsl.meshFragment, this.uniforms, { ...side, colorWrite: false }));
    this.depth.renderOrder = 10;
    this.see = new THREE.Mesh(this.geometry, material(glsl.meshVertex, glsl.meshFragment, this.uniforms, {
      ...side, transparent: true, depthFunc: THREE.LessEqualDepth, depthWrite: false,
    }));
    this.see.renderOrder = 11;
    this.add(this.solid, this.depth, this.see);
    if (this.described.edges) {
      this.edges = new THREE.LineSegments(edgesOf(this.positions), material(
        glsl.lineVertex, glsl.lineFragment, { plain: { value: new THREE.Vector3(0.25, 0.25, 0.25) } }));
      this.add(this.edges);
    }
  }

  buildDots() {
    const onTop = this.described.onTop;
    const look = material(glsl.dotVertex, glsl.dotFragment, {
      ...this.uniforms, size: { value: this.described.size * this.ratio }, only: { value: 0 },
    }, { depthTest: !onTop, depthWrite: !onTop });
    const points = new THREE.Points(this.geometry, look);
    points.renderOrder = onTop ? 100 : 0;
    this.add(points);
  }

  buildSurfels() {
    const corners = new Float32Array([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0]);
    this.geometry = new THREE.InstancedBufferGeometry();
    this.geometry.setAttribute("position", new THREE.BufferAttribute(corners, 3));
    this.geometry.setIndex([0, 1, 2, 0, 2, 3]);
    const instanced = (attribute) => new THREE.InstancedBufferAttribute(attribute.array, attribute.itemSize);
    this.facing = new THREE.InstancedBufferAttribute(new Float32Array(this.count * 3), 3);
    this.instances = { place: instanced(this.positions.attribute), value: instanced(this.value),
      state: instanced(this.state) };
    for (const [name, attribute] of Object.entries(this.instances)) this.geometry.setAttribute(name, attribute);
    this.geometry.setAttribute("facing", this.facing);
    this.geometry.instanceCount = this.count;
    const look = material(glsl.surfelVertex, glsl.surfelFragment, {
      ...this.uniforms, radius: { value: this.described.radius } }, { side: THREE.DoubleSide });
    this.add(new THREE.Mesh(this.geometry, look));
    this.dots = new THREE.BufferGeometry();
    for (const [name, attribute] of [["position", this.positions.attribute], ["value", this.value],
      ["state", this.state], ["region", this.labels]]) this.dots.setAttribute(name, attribute);
  }

  get ratio() {
    return this.store.pixelRatio ?? 1;
  }

  add(...objects) {
    for (const object of objects) {
      object.frustumCulled = false;
      this.group.add(object);
    }
  }

  /** Show the numbers of `described.scalars[index]`; -1: the plain colour. */
  choose(index) {
    this.choice = index;
    const scalars = this.scalars, u = this.uniforms;
    u.painted.value = scalars ? 1 : 0;
    u.flatness.value = scalars ? 0.8 : 0;
    if (this.marked) this.marked.material.uniforms.size.value = (scalars ? 3 : 6) * this.ratio; // numbers stay seen
    if (scalars) {
      u.limits.value.set(...scalars.limits);
      u.map.value?.dispose();
      u.map.value = tableTexture(this.store.arrays[scalars.map]);
      u.steps.value = u.map.value.image.width;
    }
    this.painted = -1;
  }

  setGhost(ghost) {
    this.ghost = ghost;
    if (!this.solid) return;
    const opacity = this.described.opacity < 1 ? this.described.opacity : 0.35;
    this.uniforms.opacity.value = ghost ? opacity : 1;
    this.solid.visible = !ghost;
    this.depth.visible = this.see.visible = ghost;
    if (this.edges) this.edges.visible = !ghost;
  }

  setRegion(index) {
    this.region = index;
    this.uniforms.isolated.value = index;
  }

  update(described) {
    this.described = described;
    this.positions.update(described.positions);
    if (described.regions) {
      this.labels.array.set(this.store.arrays[described.regions.key]);
      this.labels.needsUpdate = true;
    }
    this.choose(Math.min(this.choice, described.scalars.length - 1));
  }

  show(frame) {
    this.frame = frame;
    if (this.painted >= 0 && (this.still || this.painted === frame)) return;
    this.painted = frame;
    const scalars = this.scalars;
    let moves = this.positions.frames > 1;
    if (scalars) {
      const [T] = this.store.header.arrays[scalars.key].shape, codes = this.store.arrays[scalars.key];
      moves ||= T > 1;
      const start = (T > 1 ? frame : 0) * this.count, out = this.value.array;
      for (let i = 0; i < this.count; i++) {
        const code = codes[start + i];
        out[i] = code === NAN ? EMPTY : scalars.low + scalars.step * code;
      }
      this.value.needsUpdate = true;
    }
    const state = this.state.array, marks = this.described.marks;
    state.fill(0);
    this.markedCount = 0;
    if (marks) {
      moves ||= this.store.header.arrays[marks].shape[0] > 1;
      for (const vertex of markedVertices(this.store, marks, frame, this.count)) {
        state[vertex] = 1;
        this.markedCount++;
      }
    }
    if (this.positions.broken) for (let i = 0; i < this.count; i++) if (this.positions.broken[i]) state[i] = 2;
    this.state.needsUpdate = true;
    if (this.facing) {
      const [T] = this.store.header.arrays[this.described.normals].shape;
      moves ||= T > 1;
      const codes = this.store.arrays[this.described.normals], start = (T > 1 ? frame : 0) * this.count * 3;
      for (let i = 0; i < this.count * 3; i++) this.facing.array[i] = codes[start + i] / 127;
      this.facing.needsUpdate = true;
      for (const attribute of Object.values(this.instances)) attribute.needsUpdate = true;
    }
    this.still = !moves;
  }

  /** What a vertex is and holds in the frame that is shown. */
  read(vertex) {
    const p = this.positions.attribute.array;
    const lines = this.described.scalars.filter((s) => s.legend).map((s) => {
      const [T] = this.store.header.arrays[s.key].shape;
      const code = this.store.arrays[s.key][(T > 1 ? this.frame : 0) * this.count + vertex];
      if (code === NAN) return { name: s.name, text: "NaN" };
      const value = s.low + s.step * code;
      const text = s.categories.length ? s.categories[value] : `${number(value)} ${s.unit}`;
      return { name: s.name, text, value };
    });
    const labels = this.described.regions;
    if (labels) {
      const label = this.store.arrays[labels.key][vertex];
      if (label >= 0) lines.push({ name: "region", text: labels.names[label] });
    }
    return {
      layer: this.name, vertex, position: [p[3 * vertex], p[3 * vertex + 1], p[3 * vertex + 2]],
      marked: this.state.array[vertex] === 1, markName: this.described.markName, values: lines,
    };
  }

  dispose() {
    this.geometry.dispose();
    this.dots?.dispose();
    this.uniforms.map.value?.dispose();
    this.group.traverse((object) => object.material?.dispose());
  }
}

/** Arrows: thin needles from starts to tips. */
export class Arrows {
  constructor(store, shared, described) {
    this.described = described;
    this.name = described.name;
    this.positions = shared.of(described.positions);
    this.count = this.positions.count / 2;
    this.group = new THREE.Group();
    this.shown = true;
    this.region = -1;
    const shape = needle();
    this.mesh = new THREE.InstancedMesh(shape, new THREE.MeshBasicMaterial({
      color: new THREE.Color().setRGB(...described.colour, THREE.LinearSRGBColorSpace) }), this.count);
    this.mesh.frustumCulled = false;
    this.group.add(this.mesh);
  }

  choose() {}
  setGhost() {}
  setRegion() {}

  update(described) {
    this.described = described;
    this.positions.update(described.positions);
  }

  show() {
    const p = this.positions.attribute.array, start = new THREE.Vector3(), tip = new THREE.Vector3();
    const up = new THREE.Vector3(0, 1, 0), turn = new THREE.Quaternion(), matrix = new THREE.Matrix4();
    for (let i = 0; i < this.count; i++) {
      start.fromArray(p, 3 * i);
      tip.fromArray(p, 3 * (i + this.count)).sub(start);
      const length = tip.length();
      turn.setFromUnitVectors(up, length > 0 ? tip.clone().divideScalar(length) : up);
      matrix.compose(start, turn, new THREE.Vector3(length, length, length));
      this.mesh.setMatrixAt(i, matrix);
    }
    this.mesh.instanceMatrix.needsUpdate = true;
  }

  read() {
    return null;
  }

  dispose() {
    this.mesh.geometry.dispose();
    this.mesh.material.dispose();
    this.mesh.dispose();
  }
}

/** Indices of the marked vertices of a frame. */
export function* markedVertices(store, key, frame, count) {
  const [T, bytes] = store.header.arrays[key].shape, bits = store.arrays[key];
  const start = (T > 1 ? frame : 0) * bytes;
  for (let byte = 0; byte < bytes; byte++) {
    const set = bits[start + byte];
    if (!set) continue;
    for (let bit = 0; bit < 8; bit++) if (set & (1 << bit) && 8 * byte + bit < count) yield 8 * byte + bit;
  }
}

export function number(value) {
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e5)) return value.toExponential(2);
  return value.toFixed(size >= 100 ? 1 : size >= 1 ? 2 : 4);
}

function tableTexture(bytes) {
  const steps = bytes.length / 3, rgba = new Uint8Array(4 * steps);
  for (let i = 0; i < steps; i++) rgba.set([bytes[3 * i], bytes[3 * i + 1], bytes[3 * i + 2], 255], 4 * i);
  const texture = new THREE.DataTexture(rgba, steps, 1, THREE.RGBAFormat);
  texture.needsUpdate = true;
  return texture;
}

function edgesOf(positions) {
  const seen = new Set(), index = [], f = positions.faces, n = positions.count;
  for (let i = 0; i < f.length; i += 3)
    for (const [a, b] of [[f[i], f[i + 1]], [f[i + 1], f[i + 2]], [f[i + 2], f[i]]]) {
      const key = Math.min(a, b) * n + Math.max(a, b);
      if (seen.has(key)) continue;
      seen.add(key);
      index.push(a, b);
    }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", positions.attribute);
  geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(index), 1));
  return geometry;
}

/** An arrow of length 1 along y. */
function needle() {
  const profile = [[0, 0], [0.02, 0], [0.02, 0.72], [0.07, 0.72], [0, 1]];
  return new THREE.LatheGeometry(profile.map(([x, y]) => new THREE.Vector2(x, y)), 8);
}
