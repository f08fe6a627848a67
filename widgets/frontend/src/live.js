// The notebook's side of widgets/live.py: one store a model, kept current by messages; any number of views of it.
import { bytesOf, typed } from "./decode.js";
import { NoWebGL } from "./stage.js";
import { fault, mount } from "./view.js";
import { stream } from "./stream.js";

const GONE = "The kernel is gone: what its code would change stays as it is. Run the cell again.";

// By the key that the kernel gave the model: anywidget hands initialize and render different objects for one model.
const models = new Map();

function storeOf(model) {
  const key = model.get("key");
  let entry = models.get(key);
  if (!entry) models.set(key, (entry = { store: read(model), views: new Set() }));
  return entry;
}

function read(model) {
  const { header, buffers } = model.get("scene");
  const arrays = {};
  for (const [key, buffer] of Object.entries(buffers)) arrays[key] = typed(header.arrays[key], bytesOf(buffer));
  return { header, arrays };
}

function initialize({ model }) {
  const entry = storeOf(model);
  const onMessage = (message, buffers) => {
    if (message.kind !== "renew") return;
    const arrays = {};
    for (const key of Object.keys(message.header.arrays)) {
      const place = message.keys.indexOf(key);
      arrays[key] = place < 0 ? entry.store.arrays[key] : typed(message.header.arrays[key], bytesOf(buffers[place]));
    }
    entry.store = { header: message.header, arrays };
    for (const view of entry.views) {
      view.renew({ ...entry.store });
      view.note("");
    }
  };
  model.on("msg:custom", onMessage);
  return () => {
    model.off("msg:custom", onMessage);
    models.delete(model.get("key"));
  };
}

function render({ model, el }) {
  const entry = storeOf(model);
  const [width, height] = model.get("size");
  const host = document.createElement("div"); // el's own style belongs to the widget's layout
  host.style.cssText = `width: 100%; max-width: ${width}px`;
  el.append(host);
  let handle;
  const options = {
    width, height,
    onRest: (frame) => {
      if (model.get("frame") === frame) return;
      model.set("frame", frame);
      model.save_changes();
    },
    onPick: (read) => {
      model.set("picked", { layer: read.layer, vertex: read.vertex, frame: handle.frame() });
      model.save_changes();
    },
  };
  try {
    if (model.get("refuse_webgl")) throw new NoWebGL("switched off");
    handle = mount(host, { ...entry.store }, options);
  } catch (error) {
    if (!(error instanceof NoWebGL)) {
      fault(host, `The 3-D view could not be shown: ${error?.message ?? error}`);
      throw error;
    }
    return stream(host, model, entry.store.header, [width, height], error.message, GONE);
  }
  handle.setFrame(model.get("frame"), true);
  entry.views.add(handle);
  const onFrame = () => handle.setFrame(model.get("frame"), true);
  const onMessage = (message) => {
    if (message.kind === "fault") handle.note(message.text);
  };
  const onGone = () => handle.note(`${GONE} Turning, playing and reading still work.`);
  model.on("change:frame", onFrame);
  model.on("comm_live_update", onGone);
  model.on("msg:custom", onMessage);
  return () => {
    model.off("change:frame", onFrame);
    model.off("comm_live_update", onGone);
    model.off("msg:custom", onMessage);
    entry.views.delete(handle);
    handle.dispose();
  };
}

export default { initialize, render };
