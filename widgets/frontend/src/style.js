export const css = `
.wbv { position: relative; font: 12px/1.35 system-ui, -apple-system, "Segoe UI", sans-serif; color: #222;
  background: #f7f7f5; outline: none; border: 1px solid #d5d5d0; border-radius: 4px; overflow: hidden; user-select: none;
  display: flex; flex-direction: column; box-sizing: border-box; }
.wbv:focus-within, .wbv:focus { border-color: #6b8fb5; }
.wbv * { box-sizing: border-box; }
.wbv-picture { position: relative; overflow: hidden; }
.wbv-title { position: absolute; padding: 4px 8px; font-weight: 600; pointer-events: none; text-shadow: 0 0 3px #fff, 0 0 3px #fff; }
.wbv-box { background: #fffffff0; border: 1px solid #ddd; border-radius: 4px; padding: 4px 6px; }
.wbv-layers { position: absolute; left: 6px; bottom: 6px; max-height: 60%; overflow: auto; }
.wbv-layers table { border-spacing: 0; }
.wbv-layers td { padding: 0 3px; white-space: nowrap; }
.wbv-swatch { display: inline-block; width: 10px; height: 10px; border-radius: 2px; margin-right: 4px; vertical-align: -1px; }
.wbv button, .wbv select { font: inherit; color: inherit; background: #fff; border: 1px solid #c8c8c4; border-radius: 3px;
  padding: 1px 6px; cursor: pointer; }
.wbv button:hover { background: #eef3f8; } .wbv button.on { background: #3d6a99; color: #fff; border-color: #3d6a99; }
.wbv select { max-width: 190px; padding: 1px 2px; }
.wbv-tools { position: absolute; right: 6px; top: 6px; display: flex; gap: 4px; }
.wbv-bars { position: absolute; right: 6px; top: 36px; display: flex; flex-direction: column; gap: 6px; align-items: flex-end; pointer-events: none; }
.wbv-bar canvas { display: block; } .wbv-bar { pointer-events: auto; }
.wbv-bar .names { max-height: 240px; overflow: auto; }
.wbv-read { position: absolute; left: 6px; top: 28px; max-width: 300px; user-select: text; display: none; }
.wbv-read .row { display: flex; justify-content: space-between; gap: 12px; }
.wbv-read .scroll { max-height: 190px; overflow: auto; }
.wbv-time { display: flex; gap: 6px; align-items: center; padding: 4px 6px; border-top: 1px solid #ddd; background: #fff; }
.wbv-track { position: relative; flex: 1; min-width: 60px; } .wbv-track input { width: 100%; display: block; margin: 0; }
.wbv-track canvas { width: 100%; height: 22px; display: block; cursor: pointer; }
.wbv-count { min-width: 76px; text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
.wbv-marks { padding: 3px 8px; border-top: 1px solid #ddd; background: #fff; color: #8a0040; font-variant-numeric: tabular-nums; }
.wbv-marks.none { color: #2f6b3a; }
.wbv-note { padding: 5px 8px; background: #fff4d6; border-bottom: 1px solid #e6cf8b; }
.wbv-fault { padding: 14px; background: #fff4f4; border: 1px solid #e0a0a0; white-space: pre-wrap; user-select: text; }
.wbv-help { position: absolute; inset: 0; background: #fffffff2; padding: 14px 18px; overflow: auto; display: none; z-index: 2; }
.wbv-help kbd { background: #eee; border: 1px solid #ccc; border-radius: 3px; padding: 0 5px; }
.wbv-help td { padding: 2px 10px 2px 0; vertical-align: top; }
.wbv-hint { position: absolute; left: 50%; bottom: 8px; transform: translateX(-50%); background: #222c; color: #fff; padding: 3px 10px;
  border-radius: 10px; pointer-events: none; transition: opacity 0.6s; white-space: nowrap; }
`;
