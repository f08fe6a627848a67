// The inspector's page: chart and tables on one side, the 3-D view (window.workbenchView, if there is one) on the other.
(() => {
  const data = JSON.parse(document.getElementById("inspection").textContent);
  const cells = new Map(data.cells.map((cell) => [`${cell[0]},${cell[1]}`, cell]));
  const told = document.getElementById("told"), all = document.getElementById("all"), now = document.getElementById("now");
  let view = null, chosen = null;

  /** The frame of the 3-D view that is nearest to a frame of the sequence. */
  function nearest(frame) {
    let best = 0;
    data.shown.forEach((f, i) => { if (Math.abs(f - frame) < Math.abs(data.shown[best] - frame)) best = i; });
    return best;
  }

  function cursor(frame) {
    const x = data.left + ((frame + 0.5) * data.width) / data.frames;
    now.setAttribute("x1", x);
    now.setAttribute("x2", x);
  }

  function mark(element) {
    for (const old of document.querySelectorAll(".chosen")) old.classList.remove("chosen");
    element?.classList.add("chosen");
  }

  const seconds = (frame) => `${(frame / data.fps).toFixed(2)} s`;
  const inFile = (frame) => (data.first || data.every > 1 ? `, frame ${data.first + frame * data.every} of the file` : "");

  /** A garment vertex slides over the body, but has one region to isolate: `whole` says that it fits this cell's vertices. */
  function isolate(region, whole) {
    chosen = [region, whole];
    all.hidden = region === null;
    view?.isolateRegion("body", region);
    view?.isolateRegion("garment", whole ? region : null);
  }

  function go(frame, region, whole, vertex, text) {
    cursor(frame);
    isolate(region, whole);
    if (view) {
      const index = nearest(frame);
      view.setFrame(index);
      view.choose("garment", "depth inside the body");
      if (data.shown[index] !== frame) text += ` The 3-D view does not hold this frame; it shows frame ${data.shown[index]}.`;
      if (vertex !== null) {
        view.pick("garment", vertex);
        view.lookAt("garment", vertex);
      }
    }
    told.textContent = text;
    document.body.dataset.frame = frame;
    document.body.dataset.region = region ?? "";
  }

  function goCell(frame, r) {
    const [, , count, depth, vertex, whole] = cells.get(`${frame},${r}`);
    go(frame, data.regions[r], Boolean(whole), vertex, `${data.regions[r]}, frame ${frame} (${seconds(frame)}${inFile(frame)}): ${count} `
      + `${count === 1 ? "vertex" : "vertices"} inside, the deepest ${depth.toFixed(2)} mm (vertex ${vertex}).`);
  }

  function goFrame(frame) {
    go(frame, null, false, null, `Frame ${frame} (${seconds(frame)}${inFile(frame)}): ${data.inside[frame]} vertices inside, `
      + `the deepest ${data.deepest[frame].toFixed(2)} mm.`);
  }

  for (const cell of document.querySelectorAll("#heat .cell")) {
    cell.addEventListener("click", () => { mark(cell); goCell(+cell.dataset.f, +cell.dataset.r); });
  }
  for (const bar of document.querySelectorAll("#heat .bar")) {
    bar.addEventListener("click", () => { mark(bar); goFrame(+bar.dataset.f); });
  }
  for (const row of document.querySelectorAll("tr.go")) {
    row.addEventListener("click", () => {
      mark(row);
      goCell(+row.dataset.f, data.regions.indexOf(row.dataset.n));
      view?.pick("garment", +row.dataset.v);
      view?.lookAt("garment", +row.dataset.v);
    });
  }
  all.addEventListener("click", () => { mark(null); isolate(null, false); });

  function adopt(handle) {
    view = handle;
    const first = document.querySelector("tr.go");
    handle.onFrame((frame) => cursor(data.shown[typeof frame === "number" ? frame : handle.frame()]));
    handle.setFrame(nearest(first ? +first.dataset.f : 0));
    handle.nameFrames(data.shown);
    handle.ghost("body");
    cursor(data.shown[handle.frame()]);
    if (chosen !== null) isolate(...chosen);
  }
  if (window.workbenchView) adopt(window.workbenchView);
  else document.addEventListener("workbench-view", (event) => adopt(event.detail));
  const first = document.querySelector("tr.go");
  cursor(first ? +first.dataset.f : 0);
})();
