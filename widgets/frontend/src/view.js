// A scene with everything around it: titles, layers, scalar bars, read-out, timeline, keys.  Needs no kernel.
import { NoWebGL, Stage } from "./stage.js";
import { markedVertices, number } from "./layers.js";
import { css } from "./style.js";

const HELP = [
  ["drag", "turn"], ["right drag, or shift + drag", "shift"], ["wheel", "nearer, farther (in a notebook: after a click into the view)"],
  ["click", "read the vertex there: its number, its place, its values; again beside everything: let go"],
  ["space", "play, pause"], ["← →", "one frame back, on"], ["home, end", "first, last frame"],
  ["g", "see through the first layer (the body), or not"], ["1 … 9", "hide or show a layer"], ["i", "only the layer read last, or all again"],
  ["c", "the next quantity that is shown by colour"], ["r", "camera back to where it was"], ["s", "save a picture (PNG)"],
  ["?", "this help"], ["esc", "close, let go"],
];
const SPEEDS = [0.25, 0.5, 1, 2];
const WARNING = "rgb(242, 0, 115)";

export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (key === "class") made.className = value;
    else if (value !== undefined && value !== false) made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== null));
  return made;
}

const rgb = (colour) => `rgb(${colour.map((x) => Math.round(255 * x)).join(",")})`;

/** The style belongs to the page once, or to each shadow root. */
function addStyle(root) {
  root.append(element("style", {}, css));
}

export function fault(host, text) {
  const told = element("div", { class: "wbv-fault", role: "alert" }, text);
  host.append(told);
  return told;
}

/** Show `store` in `host`.  Raises NoWebGL.  Returns a handle; see `handle` at the end. */
export function mount(host, store, options = {}) {
  const view = new SceneView(host, store, options);
  return view.handle;
}

class SceneView {
  constructor(host, store, options) {
    this.store = store;
    this.options = options;
    this.listeners = { frame: new Set(), pick: new Set() };
    this.root = element("div", { class: "wbv", tabindex: 0, role: "application", "aria-label": "3-D view" });
    addStyle(this.root);
    host.append(this.root);
    this.picture = element("div", { class: "wbv-picture" });
    this.root.append(this.picture);
    try {
      this.stage = new Stage(this.picture, store);
    } catch (error) {
      this.root.remove();
      throw error instanceof NoWebGL ? error : new NoWebGL(String(error?.message ?? error));
    }
    this.playing = false;
    this.speed = 1;
    this.build();
    this.bind();
    this.layout();
    this.handle = this.makeHandle();
  }

  get header() {
    return this.store.header;
  }

  get names() {
    return [...new Set(this.stage.layers.map((layer) => layer.name))];
  }

  // what stands around the picture

  build() {
    for (const part of this.parts ?? []) part.remove();
    this.parts = [];
    const put = (parent, part) => {
      parent.append(part);
      this.parts.push(part);
      return part;
    };
    this.titles = this.header.views.map((view) => put(this.picture, element("div", { class: "wbv-title" }, view.title)));
    const button = (text, title, onclick, more) => element("button", { type: "button", title, "aria-label": title, onclick, ...more }, text);
    const through = this.names.length > 1 || this.stage.layers[0]?.solid;
    this.ghostButton = through
      ? button("see through", "see through the first layer (g)", () => this.ghost(), { "data-do": "ghost" }) : null;
    put(this.picture, element("div", { class: "wbv-tools" },
      this.ghostButton,
      button("⟲", "camera back (r)", () => this.home(), { "data-do": "home" }),
      button("⤓", "save a picture (s)", () => this.save(), { "data-do": "save" }),
      button("?", "keys and mouse (?)", () => this.toggleHelp(), { "data-do": "help" })));
    this.help = put(this.picture, element("div", { class: "wbv-help" },
      element("b", {}, "Mouse and keys"), element("table", {}, ...HELP.map(([key, does]) =>
        element("tr", {}, element("td", {}, element("kbd", {}, key)), element("td", {}, does))))));
    this.layerBox = put(this.picture, element("div", { class: "wbv-box wbv-layers" }));
    this.bars = put(this.picture, element("div", { class: "wbv-bars" }));
    this.read = put(this.picture, element("div", { class: "wbv-box wbv-read" }));
    this.buildNotices(put);
    this.marks = put(this.root, element("div", { class: "wbv-marks", role: "status" }));
    this.time = this.header.frames > 1 ? put(this.root, this.buildTime(button)) : null;
    this.drawLayers();
    this.drawBars();
    this.curve();
    this.onFrame();
  }

  buildNotices(put) {
    for (const text of this.header.notices) {
      const note = put(this.root, element("div", { class: "wbv-note", role: "alert" }, text));
      this.root.insertBefore(note, this.picture);
    }
  }

  buildTime(button) {
    const last = this.header.frames - 1;
    this.play = button("▶ play", "play, pause (space)", () => this.toggle(), { class: "wbv-play", style: "width: 68px" });
    this.range = element("input", { type: "range", min: 0, max: last, value: this.stage.frame, class: "wbv-range",
      "aria-label": "frame", oninput: () => { this.pause(); this.setFrame(+this.range.value); },
      onchange: () => this.tell() });
    this.strip = element("canvas", { height: 22, title: "marked vertices of each frame: click to go there",
      onclick: (event) => {
        const place = this.strip.getBoundingClientRect();
        this.pause();
        this.setFrame(Math.round(((event.clientX - place.left) / place.width) * last));
        this.tell();
      } });
    this.counter = element("span", { class: "wbv-count" });
    const speed = element("select", { title: "speed of playing", "aria-label": "speed", onchange: () => {
      this.speed = +speed.value;
      this.start = null;
    } }, ...SPEEDS.map((s) => element("option", { value: s, ...(s === 1 ? { selected: true } : {}) }, `× ${s}`)));
    return element("div", { class: "wbv-time" }, this.play, element("div", { class: "wbv-track" }, this.strip, this.range),
      this.counter, speed);
  }

  drawLayers() {
    const rows = this.names.map((name, index) => {
      const layers = this.stage.named(name), first = layers[0], scalars = first.described.scalars ?? [];
      const check = element("input", { type: "checkbox", "data-layer": name, ...(first.shown ? { checked: true } : {}),
        title: `show or hide (${index + 1})`, onchange: () => this.showLayer(name, check.checked) });
      const options = [...(first.described.plain ? [[-1, "plain colour"]] : []), ...scalars.map((s, i) => [i, s.name])];
      const choice = options.length > 1
        ? element("select", { title: "what the colour shows (c)", "aria-label": `colour of ${name}`, onchange: () =>
            this.choose(name, +choice.value) }, ...options.map(([value, text]) =>
            element("option", { value, ...(value === first.choice ? { selected: true } : {}) }, text))) : null;
      const names = first.described.regions?.names ?? [];
      const region = names.length
        ? element("select", { title: "isolate a region", "aria-label": `region of ${name}`, onchange: () =>
            this.isolateRegion(name, region.value) }, element("option", { value: "" }, "all regions"),
            ...names.map((n, i) => element("option", { value: n, ...(i === first.region ? { selected: true } : {}) }, n))) : null;
      const label = element("label", { style: "cursor:pointer" }, check, " ",
        element("span", { class: "wbv-swatch", style: `background:${rgb(first.described.colour)}` }), name);
      const only = this.names.length > 1
        ? element("button", { type: "button", "data-only": name, class: this.only === name ? "on" : "", title: "only this layer, or all again (i)",
            onclick: () => this.isolateLayer(this.only === name ? null : name) }, "only") : "";
      return element("tr", {}, element("td", {}, label), element("td", {}, only),
        element("td", {}, ...[choice, region].filter(Boolean)));
    });
    this.layerBox.replaceChildren(element("table", {}, ...rows));
    this.layerBox.style.display = this.names.length > 1 || rows.some((r) => r.querySelector("select")) ? "" : "none";
  }

  /** One bar for every quantity that is shown. */
  drawBars() {
    const bars = new Map();
    for (const layer of this.stage.layers) {
      const s = layer.shown && layer.scalars;
      if (s && s.legend) bars.set(`${s.name}|${s.limits}|${s.map}`, { s, table: this.store.arrays[s.map] });
    }
    this.bars.replaceChildren(...[...bars.values()].map(({ s, table }) =>
      s.categories.length ? namesBar(s, table) : gradientBar(s, table)));
  }

  /** Marked vertices of every frame, over the timeline. */
  curve() {
    if (!this.time) return;
    const keys = new Map();
    for (const layer of this.stage.layers) if (layer.described.marks) keys.set(layer.described.marks, layer.count);
    this.counts = new Float64Array(this.header.frames);
    for (const [key, count] of keys) {
      const [T] = this.header.arrays[key].shape;
      for (let t = 0; t < this.header.frames; t++)
        if (T > 1 || t === 0) for (const _ of markedVertices(this.store, key, t, count)) this.counts[t]++;
    }
    this.strip.style.display = keys.size && this.counts.some((c) => c > 0) ? "" : "none";
    this.drawCurve();
  }

  drawCurve() {
    if (!this.time || this.strip.style.display === "none") return;
    const width = (this.strip.width = Math.max(60, this.strip.clientWidth || 300)), pen = this.strip.getContext("2d");
    const most = Math.max(...this.counts), n = this.counts.length;
    pen.fillStyle = WARNING;
    for (let t = 0; t < n; t++) {
      const height = (20 * this.counts[t]) / most;
      pen.fillRect((t / n) * width, 22 - height, Math.max(1, width / n - 0.5), height);
    }
    pen.fillStyle = "#222";
    pen.fillRect(((this.stage.frame + 0.5) / n) * width - 0.5, 0, 1, 22);
  }

  // acting

  setFrame(frame, quiet = false) {
    const last = this.header.frames - 1, next = Math.max(0, Math.min(last, Math.round(frame)));
    if (next !== this.stage.frame) this.stage.showFrame(next);
    this.onFrame();
    if (!quiet) for (const listener of this.listeners.frame) listener(next);
  }

  onFrame() {
    const frame = this.stage.frame;
    this.root.dataset.frame = frame;
    if (this.time) {
      this.range.value = frame;
      const named = (index) => this.frameNames?.[index] ?? index;
      this.counter.textContent = `${named(frame)} / ${named(this.header.frames - 1)}`;
      this.drawCurve();
    }
    const told = [];
    this.header.views.forEach((view, v) => {
      for (const layer of this.stage.views[v].layers) {
        if (layer.described.marks === undefined) continue;
        const where = this.header.views.length > 1 && view.title ? `${view.title}, ` : "";
        told.push({ text: `${where}${layer.name}: ${layer.markedCount} of ${layer.count.toLocaleString("en")} vertices ${layer.described.markName}`,
          count: layer.markedCount });
      }
    });
    this.marks.style.display = told.length ? "" : "none";
    this.marks.textContent = told.map((t) => t.text).join("   ·   ");
    this.marks.classList.toggle("none", told.every((t) => t.count === 0));
    if (this.stage.pinned) this.showRead();
  }

  toggle() {
    this.playing ? this.pause() : this.resume();
  }

  resume() {
    if (!this.time) return;
    this.playing = true;
    this.start = null;
    this.play.textContent = "⏸ pause";
    this.root.dataset.playing = "1";
  }

  pause() {
    if (!this.playing) return;
    this.playing = false;
    this.play.textContent = "▶ play";
    delete this.root.dataset.playing;
    this.tell();
  }

  /** Tell the kernel once the hand is off: frames that pass by stay here. */
  tell() {
    this.options.onRest?.(this.stage.frame);
  }

  tick(now) {
    if (!this.playing) return;
    this.start ??= { now, frame: this.stage.frame };
    const passed = Math.floor(((now - this.start.now) / 1000) * this.header.fps * this.speed);
    const next = (this.start.frame + passed) % this.header.frames;
    if (next !== this.stage.frame) this.setFrame(next);
  }

  showLayer(name, shown) {
    for (const layer of this.stage.named(name)) layer.group.visible = layer.shown = shown;
    this.only = null;
    this.refresh();
  }

  isolateLayer(name) {
    this.only = name;
    for (const layer of this.stage.layers) layer.group.visible = layer.shown = name === null || layer.name === name;
    this.refresh();
  }

  isolateRegion(name, region) {
    for (const layer of this.stage.named(name)) layer.setRegion((layer.described.regions?.names ?? []).indexOf(region));
    this.refresh();
  }

  choose(name, index) {
    for (const layer of this.stage.named(name)) {
      layer.choose(index);
      layer.show(this.stage.frame);
    }
    this.refresh();
  }

  ghost(name = this.names[0]) {
    const layers = this.stage.named(name), ghost = !layers[0]?.ghost;
    for (const layer of layers) layer.setGhost(ghost);
    this.ghostButton?.classList.toggle("on", ghost);
    this.stage.dirty = true;
  }

  home() {
    for (const rig of this.stage.rigs) rig.home();
  }

  refresh() {
    this.drawLayers();
    this.drawBars();
    this.stage.dirty = true;
  }

  save() {
    element("a", { href: this.stage.png(), download: `view_frame${this.stage.frame}.png` }).click();
  }

  toggleHelp(open = this.help.style.display !== "block") {
    this.help.style.display = open ? "block" : "none";
  }

  pick(layer, vertex) {
    this.stage.pinAt(layer, vertex);
    this.showRead();
    const read = layer.read(vertex);
    for (const listener of this.listeners.pick) listener(read);
    this.options.onPick?.(read);
  }

  letGo() {
    this.stage.unpin();
    this.read.style.display = "none";
  }

  showRead() {
    const { layer, vertex } = this.stage.pinned, read = layer.read(vertex);
    const row = (name, text, style) => element("div", { class: "row", ...(style ? { style } : {}) }, element("span", {}, name), element("b", {}, text));
    // of many numbers (weights of 31 joints) those that are not zero, largest first
    const many = read.values.length > 6;
    const values = many ? read.values.filter((v) => !(Math.abs(v.value) < 5e-4)).sort((a, b) => Math.abs(b.value ?? 1e9) - Math.abs(a.value ?? 1e9)) : read.values;
    this.read.replaceChildren(
      element("b", {}, `${read.layer}, vertex ${read.vertex}`),
      row("x, y, z", `${read.position.map((x) => x.toFixed(4)).join(", ")} m`),
      element("div", { class: "scroll" }, ...values.map((v) => row(v.name, v.text))),
      ...(read.markName ? [row(read.markName, read.marked ? "yes" : "no", read.marked ? `color:${WARNING}` : "")] : []));
    this.read.style.display = "block";
    this.root.dataset.picked = vertex;
  }

  // hands

  bind() {
    this.stage.tick = (now) => this.tick(now);
    this.stage.afterDraw = () => (this.root.dataset.drawn = this.stage.drawn);
    const canvas = this.stage.canvas;
    let down = null;
    canvas.addEventListener("pointerdown", (event) => {
      down = [event.clientX, event.clientY];
      this.root.focus({ preventScroll: true });
    });
    canvas.addEventListener("pointerup", (event) => {
      if (!down || Math.hypot(event.clientX - down[0], event.clientY - down[1]) > 4 || event.button !== 0) return;
      const hit = this.stage.pick(event);
      if (hit) this.pick(hit.layer, hit.vertex);
      else this.letGo();
    });
    // a wheel over a view in a notebook scrolls the notebook, unless the view was clicked
    this.picture.addEventListener("wheel", (event) => {
      if (this.options.wheelFree || this.root.contains(document.activeElement) || this.root === this.root.getRootNode().activeElement) return;
      event.stopPropagation();
      this.hint("click into the view, then the wheel zooms");
    }, { capture: true, passive: true });
    this.root.addEventListener("keydown", (event) => this.key(event));
    canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      if (this.stage.alive) this.lost();
    });
    this.observer = new ResizeObserver(() => this.layout());
    this.observer.observe(this.root);
  }

  hint(text) {
    this.hinted?.remove();
    const hint = (this.hinted = element("div", { class: "wbv-hint" }, text));
    this.picture.append(hint);
    setTimeout(() => (hint.style.opacity = 0), 1500);
    setTimeout(() => hint.remove(), 2200);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || ["SELECT"].includes(event.target.tagName)) return;
    const last = this.header.frames - 1, step = (by) => { this.pause(); this.setFrame(this.stage.frame + by); this.tell(); };
    const scalars = () => this.names.map((n) => [n, this.stage.named(n)[0]]).find(([, l]) => (l.described.scalars?.length ?? 0) + (l.described.plain ? 1 : 0) > 1);
    const does = {
      " ": () => this.toggle(), ArrowLeft: () => step(-1), ArrowRight: () => step(1), Home: () => this.setFrame(0), End: () => this.setFrame(last),
      g: () => this.ghost(), r: () => this.home(), s: () => this.save(), "?": () => this.toggleHelp(),
      i: () => this.isolateLayer(this.only ? null : (this.stage.pinned?.layer.name ?? this.names.at(-1))),
      c: () => {
        const found = scalars();
        if (!found) return;
        const [name, layer] = found, least = layer.described.plain ? -1 : 0, n = layer.described.scalars.length;
        this.choose(name, layer.choice + 1 < n ? layer.choice + 1 : least);
      },
      Escape: () => { this.toggleHelp(false); this.letGo(); },
    };
    const digit = this.names[+event.key - 1];
    if (does[event.key]) does[event.key]();
    else if (digit !== undefined) this.showLayer(digit, !this.stage.named(digit)[0].shown);
    else return;
    // JupyterLab has keys of its own
    event.preventDefault();
    event.stopPropagation();
  }

  lost() {
    const again = element("button", { type: "button", onclick: () => {
      cover.remove();
      this.remake();
    } }, "show it again");
    const cover = element("div", { class: "wbv-help", style: "display:block" },
      "The browser took this view's WebGL context away: it keeps some 16, and the newest views have them. ", again);
    this.picture.append(cover);
  }

  remake() {
    const frame = this.stage.frame;
    this.stage.dispose();
    this.stage = new Stage(this.picture, this.store);
    this.width = 0;
    this.build();
    this.bind();
    this.layout();
    this.setFrame(frame, true);
  }

  layout() {
    const width = Math.max(this.root.clientWidth, 120);
    const around = [...this.root.children].filter((c) => c !== this.picture && c.tagName !== "STYLE").reduce((sum, c) => sum + c.offsetHeight, 0);
    const height = this.options.fill
      ? Math.max(160, this.root.clientHeight - around)
      : Math.round((width * this.options.height) / this.options.width);
    this.picture.style.height = `${height}px`;
    this.stage.resize(width, height);
    this.titles.forEach((title, index) => {
      const [left, top] = this.stage.box(index);
      title.style.left = `${left}px`;
      title.style.top = `${top}px`;
    });
    this.drawCurve();
  }

  /** A line over the view; "" takes it away. */
  note(text) {
    this.noted?.remove();
    this.noted = text ? element("div", { class: "wbv-note", role: "alert" }, text) : null;
    if (this.noted) this.root.insertBefore(this.noted, this.picture);
    this.layout();
  }

  /** Other arrays: in place where the structure is the same, else built anew with the camera kept. */
  renew(store) {
    const same = store.header.signature === this.header.signature;
    this.store.header = store.header;
    this.store.arrays = store.arrays;
    if (same) {
      this.stage.renew(this.store);
      this.titles.forEach((title, index) => (title.textContent = this.header.views[index].title));
      this.drawBars();
      this.curve();
      this.onFrame();
      return;
    }
    const [kept] = this.stage.rigs, frame = Math.min(this.stage.frame, this.header.frames - 1);
    const look = [kept.camera.position.clone(), kept.controls.target.clone()];
    this.stage.clear();
    this.stage.build(this.store);
    const [rig] = this.stage.rigs;
    rig.camera.position.copy(look[0]);
    rig.controls.target.copy(look[1]);
    rig.controls.update();
    this.build();
    this.layout();
    this.setFrame(frame, true);
  }

  makeHandle() {
    return {
      element: this.root,
      setFrame: (frame, quiet) => { this.pause(); this.setFrame(frame, quiet); },
      frame: () => this.stage.frame,
      frames: () => this.header.frames,
      play: () => this.resume(),
      pause: () => this.pause(),
      isolateLayer: (name) => this.isolateLayer(name),
      isolateRegion: (layer, region) => this.isolateRegion(layer, region ?? ""),
      choose: (layer, name) => this.choose(layer, this.stage.named(layer)[0].described.scalars.findIndex((s) => s.name === name)),
      ghost: (layer) => this.ghost(layer),
      read: (layer, vertex) => this.stage.named(layer)[0]?.read(vertex),
      pick: (layer, vertex) => this.pick(this.stage.named(layer)[0], vertex),
      lookAt: (layer, vertex, reach = 0.3) => this.stage.lookAt(this.stage.named(layer)[0], vertex, reach),
      nameFrames: (names) => { this.frameNames = names; this.onFrame(); },
      onFrame: (listener) => this.listeners.frame.add(listener),
      onPick: (listener) => this.listeners.pick.add(listener),
      renew: (store) => this.renew(store),
      png: () => this.stage.png(),
      note: (text) => this.note(text),
      dispose: () => {
        this.observer.disconnect();
        this.stage.dispose();
        this.root.remove();
      },
    };
  }
}

function gradientBar(s, table) {
  const height = 130, canvas = element("canvas", { width: 84, height: height + 30 }), pen = canvas.getContext("2d");
  const steps = table.length / 3, [low, high] = s.limits;
  for (let y = 0; y < height; y++) {
    const i = 3 * Math.min(steps - 1, Math.floor((1 - y / height) * steps));
    pen.fillStyle = `rgb(${table[i]},${table[i + 1]},${table[i + 2]})`;
    pen.fillRect(0, 6 + y, 14, 1);
  }
  pen.fillStyle = "#222";
  pen.font = "11px system-ui, sans-serif";
  for (const share of [0, 0.5, 1]) pen.fillText(number(low + share * (high - low)), 19, 10 + height * (1 - share));
  if (s.threshold !== null && s.threshold !== undefined) {
    pen.fillStyle = WARNING;
    pen.fillRect(0, height + 12, 14, 10);
    pen.fillText(`< ${number(s.threshold)}`, 19, height + 21);
  }
  return element("div", { class: "wbv-box wbv-bar" }, element("div", {}, s.unit ? `${s.name} (${s.unit})` : s.name), canvas);
}

function namesBar(s, table) {
  const rows = s.categories.map((name, i) => element("div", {}, element("span", { class: "wbv-swatch",
    style: `background:rgb(${table[3 * i]},${table[3 * i + 1]},${table[3 * i + 2]})` }), name));
  return element("div", { class: "wbv-box wbv-bar" }, element("div", {}, s.name), element("div", { class: "names" }, ...rows));
}
