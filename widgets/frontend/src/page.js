// A page that holds its scene: reads the header and the blob beside it, shows them, and leaves `workbenchView` behind.
import { inflate, unpack } from "./decode.js";
import { NoWebGL } from "./stage.js";
import { fault, mount } from "./view.js";

async function start() {
  const host = document.getElementById("view");
  try {
    const header = JSON.parse(document.getElementById("scene-header").textContent);
    const blob = await inflate(document.getElementById("scene-arrays").textContent.trim());
    const handle = mount(host, { header, arrays: unpack(header, blob) }, { fill: true, wheelFree: true });
    handle.element.style.height = "100%";
    document.getElementById("picture-instead")?.remove();
    globalThis.workbenchView = handle;
    document.dispatchEvent(new CustomEvent("workbench-view", { detail: handle }));
  } catch (error) {
    fault(host, error instanceof NoWebGL
      ? `The 3-D view needs WebGL 2, which this browser does not give (${error.message}).\n`
        + "Open the page in a current Firefox, Chrome, Edge or Safari, with hardware acceleration switched on."
      : `The 3-D view could not be shown: ${error?.message ?? error}`);
    if (!(error instanceof NoWebGL)) throw error;
  }
}

start();
