// node build.js OUT: bundles src/live.js (for notebooks) and src/page.js (for pages) into OUT.
import * as esbuild from "esbuild";

const common = { bundle: true, minify: true, target: "es2022", legalComments: "inline", logLevel: "error" };
const out = process.argv[2];
await esbuild.build({ ...common, entryPoints: ["src/live.js"], format: "esm", outfile: `${out}/view.js` });
await esbuild.build({ ...common, entryPoints: ["src/page.js"], format: "iife", outfile: `${out}/page.js` });
