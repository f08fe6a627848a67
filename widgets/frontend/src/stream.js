// Without WebGL: the kernel draws, and sends JPEGs.  Turning and scrubbing then need a kernel that can draw.
import { element, fault } from "./view.js";

const turned = ([x, y, z], angle) => [
  x * Math.cos(angle) - y * Math.sin(angle), x * Math.sin(angle) + y * Math.cos(angle), z];

export function stream(host, model, header, [width, height], reason, gone) {
  const note = element("div", { class: "wbv-note", role: "alert", style: "padding:4px 8px;background:#fff4d6" },
    `No WebGL (${reason}): the kernel draws, more slowly. Drag to turn, wheel to zoom.`);
  const image = element("img", { class: "wbv-stream", draggable: "false", alt: "waiting for the kernel's picture",
    style: `width:100%;aspect-ratio:${width}/${height};display:block;background:#eee` });
  const root = element("div", { class: "wbv-fallback" }, note, image);
  host.append(root);
  let { position, target, up, angle } = header.camera, frame = model.get("frame"), asked = false, again = false, waiting, told;
  const ask = () => {
    if (asked) return void (again = true);
    asked = true;
    clearTimeout(waiting);
    waiting = setTimeout(() => (note.textContent = "The kernel does not answer: it is busy or gone. Run the cell again."), 20000);
    model.send({ kind: "draw", camera: { position, target, up, angle }, frame });
  };
  const onGone = () => (note.textContent = gone);
  const onMessage = (message, buffers) => {
    if (message.kind === "renew") {
      if (range) range.max = message.header.frames - 1;
      frame = Math.min(frame, message.header.frames - 1);
      return ask();
    }
    if (message.kind !== "picture" && message.kind !== "fault") return;
    asked = false;
    clearTimeout(waiting);
    told?.remove();
    told = message.kind === "fault" ? fault(root, message.text) : null;
    if (told) return;
    const before = image.src;
    image.src = URL.createObjectURL(new Blob([buffers[0]], { type: "image/jpeg" }));
    if (before) URL.revokeObjectURL(before);
    root.dataset.drawn = +(root.dataset.drawn ?? 0) + 1;
    if (again) {
      again = false;
      ask();
    }
  };
  model.on("msg:custom", onMessage);
  model.on("comm_live_update", onGone);
  let last = null;
  image.addEventListener("pointerdown", (event) => {
    last = [event.clientX, event.clientY];
    image.setPointerCapture(event.pointerId);
  });
  image.addEventListener("pointermove", (event) => {
    if (!last) return;
    const [dx, dy] = [event.clientX - last[0], event.clientY - last[1]];
    last = [event.clientX, event.clientY];
    let arm = turned(position.map((p, i) => p - target[i]), -dx * 0.01);
    const flat = Math.hypot(arm[0], arm[1]), length = Math.hypot(...arm);
    const lift = Math.max(-1.4, Math.min(1.4, Math.atan2(arm[2], flat) + dy * 0.01));
    arm = [(arm[0] / (flat || 1)) * Math.cos(lift) * length, (arm[1] / (flat || 1)) * Math.cos(lift) * length, Math.sin(lift) * length];
    position = arm.map((a, i) => a + target[i]);
    ask();
  });
  image.addEventListener("pointerup", () => (last = null));
  image.addEventListener("wheel", (event) => {
    event.preventDefault();
    position = position.map((p, i) => target[i] + (p - target[i]) * Math.exp(event.deltaY * 0.001));
    ask();
  });
  const range = header.frames > 1
    ? element("input", { type: "range", min: 0, max: header.frames - 1, value: frame, class: "wbv-range", style: "width:100%",
        "aria-label": "frame", oninput: () => { frame = +range.value; ask(); },
        onchange: () => { model.set("frame", frame); model.save_changes(); } })
    : null;
  if (range) root.append(range);
  ask();
  return () => {
    clearTimeout(waiting);
    model.off("msg:custom", onMessage);
    model.off("comm_live_update", onGone);
  };
}
