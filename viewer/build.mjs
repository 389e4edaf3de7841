// Builds the viewer of the reports as one classic script, because browsers do not load modules from file://, and script
// and style sheet of the page for marking.
//   npm ci && node build.mjs            writes them where the program has them
//   node build.mjs OTHER_FOLDER         writes them there
import { readFileSync } from "node:fs"
import { join } from "node:path"
import { fileURLToPath } from "node:url"
import { build } from "esbuild"

const here = (path) => fileURLToPath(new URL(path, import.meta.url))
const version = (library) => JSON.parse(readFileSync(here(`node_modules/${library}/package.json`), "utf8")).version
const place = (folder, name) => join(process.argv[2] ?? here(`../sfm/${folder}`), name)
const shared = {
  bundle: true,
  minify: true,
  target: "es2022",
  charset: "ascii", // scripts are embedded in pages of any encoding
  legalComments: "none", // the licences are in LICENSES.txt beside each script
}

await build({
  ...shared,
  entryPoints: [here("src/main.js")],
  outfile: place("report/viewer", "viewer.js"),
  format: "iife",
  banner: { js: `/* Viewer of Kolinear with three.js ${version("three")}; licences: LICENSES.txt of its source. */` },
})
await build({
  ...shared,
  entryPoints: [here("src/mark/main.js")],
  outfile: place("products/marking/page", "mark.js"),
  format: "iife",
  banner: { js: `/* Marking of Kolinear with OpenSeadragon ${version("openseadragon")}; licences: LICENSES.txt beside it. */` },
})
await build({ ...shared, entryPoints: [here("src/mark/mark.css")], outfile: place("products/marking/page", "mark.css") })
