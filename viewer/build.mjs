// Builds the viewer of the reports as one classic script, because browsers do not load modules from file://.
//   npm ci && node build.mjs            writes ../sfm/report/viewer/viewer.js
//   node build.mjs OTHER_FILE           writes it there
import { readFileSync } from "node:fs"
import { fileURLToPath } from "node:url"
import { build } from "esbuild"

const here = (path) => fileURLToPath(new URL(path, import.meta.url))
const three = JSON.parse(readFileSync(here("node_modules/three/package.json"), "utf8"))

await build({
  entryPoints: [here("src/main.js")],
  outfile: process.argv[2] ?? here("../sfm/report/viewer/viewer.js"),
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  charset: "ascii", // the script is embedded in pages of any encoding
  legalComments: "none", // the licences are in LICENSES.txt beside the script
  banner: { js: `/* Viewer of Kolinear with three.js ${three.version}; licences: LICENSES.txt of its source. */` },
})
