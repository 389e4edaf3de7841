// The viewer of a report: puts scene, panel and tables into the page and passes the selection between them.

import * as THREE from "three"
import { drawLegend, photoScale, pointScales } from "./colours.js"
import { MAX_ELLIPSOIDS } from "./ellipsoids.js"
import { unpack } from "./data.js"
import { button, choice, Hub, make, tick } from "./page.js"
import { Panel } from "./panel.js"
import { counted, roundStep, sigmaWords, significant } from "./numbers.js"
import { Scene } from "./scene.js"
import { tablesOf } from "./columns.js"

THREE.ColorManagement.enabled = false // colours equal those of the legend exactly

async function start() {
  const begun = performance.now()
  const root = document.getElementById("explore")
  if (!root) return
  const model = await unpack("viewer-data")
  root.hidden = false
  document.querySelector("nav")?.prepend(make("a", { href: "#explore" }, "Explore"))
  const hub = new Hub()
  const canvas = make("canvas", { className: "v-scene", tabIndex: 0 })
  canvas.setAttribute("role", "application")
  canvas.setAttribute("aria-label", "3D scene: arrow keys rotate, + and - zoom, Home resets the view")
  const overlay = make("canvas", { className: "v-overlay", "aria-hidden": "true" })
  const hover = make("div", { className: "v-hover", hidden: true })
  const legends = make("div", { className: "v-legends" })
  const stage = make("div", { className: "v-stage" }, canvas, overlay, hover)
  const view = make("div", { className: "v-view" }, legends, stage)
  const tools = make("div", { className: "v-tools v-top" })
  const panel = make("div", { className: "v-panel", tabIndex: 0, role: "region", "aria-label": "selection" })
  const tables = make("div", { className: "v-tables" })
  root.querySelector(".v-app").replaceChildren(tools, make("div", { className: "v-main" }, view, panel), tables)

  let scene = null
  try {
    scene = new Scene(model, canvas, overlay, hub)
  } catch (error) {
    stage.replaceChildren(make("p", { className: "v-nogl" }, `The 3D scene needs WebGL, which this browser does not provide: ${error.message}`))
  }
  if (scene) {
    scene.renderer.outputColorSpace = THREE.LinearSRGBColorSpace
    toolbar(model, scene, hub, tools, legends)
    const thin = make("div", { className: "v-thin", hidden: true })
    stage.append(thin)
    hub.on("thin", (part) => {
      thin.hidden = part === 1
      if (part > 1) thin.textContent = `1 in ${part} points shown while the scene moves`
    })
    hub.on("hover", (told) => showHover(model, stage, hover, told))
    hub.on("select", (found) => scene.select(found))
  }
  new Panel(model, panel, hub, scene ?? { measure() {} })
  tablesOf(model, hub, tables)
  document.addEventListener("keydown", (event) => {
    if (event.key === "Escape" && root.contains(event.target)) hub.tell("select", null)
  })
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => scene?.paint())
  let printed = null // a copy, because the canvas of the scene is already empty when the page is laid out for print
  const print = (on) => {
    if (!scene) return
    scene.printing = on
    scene.paint()
    printed?.remove()
    printed = on ? pictureOf(scene) : null
    if (printed) stage.append(printed)
    else scene.draw()
  }
  window.addEventListener("beforeprint", () => print(true))
  window.addEventListener("afterprint", () => print(false))
  matchMedia("print").addEventListener("change", () => scene?.paint())
  requestAnimationFrame(() => requestAnimationFrame(() => (root.dataset.ready = (performance.now() - begun).toFixed(0))))
  root.viewer = { model, scene, hub } // for tests
}

function toolbar(model, scene, hub, tools, legends) {
  const { scales, values } = pointScales(model)
  const photos = photoScale(model)
  const own = make("div", { className: "v-legend" })
  const other = make("div", { className: "v-legend" })
  legends.append(own, other)
  let by = ["displacement", "deviation", "photographed", "sigma", "rms", "rays"].find((key) => scales[key])
  let byPhoto = photos ? "rms" : ""
  const paint = () => {
    for (const scale of [...Object.values(scales), ...(photos ? [photos] : [])]) scale.dark = scene.dark
    scene.points.paint(values[by], scales[by])
    scene.photographs.paint(model.a["photo.rms"], byPhoto === "rms" ? photos : null)
    drawLegend(scales[by], own, make, paint)
    other.hidden = byPhoto !== "rms"
    if (byPhoto === "rms") drawLegend(photos, other, make, paint)
    scene.scales = { point: scales[by], photograph: photos, values: values[by] }
    scene.invalidate()
  }
  scene.paint = paint
  const find = make("input", { type: "search", placeholder: "point or photograph", "aria-label": "find by name" })
  find.setAttribute("list", "viewer-names")
  const names = make("datalist", { id: "viewer-names" })
  find.addEventListener("input", () => suggest(model, find.value, names))
  find.addEventListener("change", () => findName(model, scene, hub, find))
  const words = { photographed: "photographs", sigma: "sigma", rays: "rays", rms: "RMS", angle: "intersection angle", deviation: "deviation", displacement: "displacement" }
  const options = Object.keys(scales).map((key) => [key, words[key]])
  const views = [["", "view\u2026"], ["home", "object only"], ["all", "object and photographs"], ...["+X", "-X", "+Y", "-Y", "+Z", "-Z"].map((v) => [v, `from ${v}`])]
  const standard = choice("", views, (name) => {
    if (name) scene.standard(name)
    standard.firstElementChild.value = ""
  }, { "aria-label": "standard views" })
  tools.append(
    find,
    names,
    choice("colour points by", options, (value) => (by = value) && paint(), { value: by, id: "points-by" }),
    ...(photos
      ? [
          choice("colour photographs by", [["rms", "RMS"], ["", "none"]], (value) => {
            byPhoto = value
            paint()
          }),
        ]
      : []),
    standard,
    button("reset", () => scene.begin(), { title: "back to the first view" }),
    tick("orthographic", false, (on) => scene.setOrthographic(on)),
    tick("names", false, (on) => {
      scene.names = on
      scene.invalidate()
    }),
    tick("photographs", true, (on) => {
      scene.photographs.object.visible = on
      scene.invalidate()
    }),
    tick("rays of the selection", false, (on) => {
      scene.rays.on = on
      scene.rays.show(scene.selected ?? null)
      scene.invalidate()
    }),
    tick("all rejected rays", false, (on) => {
      scene.rays.showRejected(on)
      scene.invalidate()
    }),
    ...displacementTools(scene),
    ...ellipsoidTools(model, scene),
    button("save image", () => savePicture(scene, model.name)),
  )
  paint()
}

/** The check box of the displacements, and their exaggeration. */
function displacementTools(scene) {
  const { displacements } = scene
  if (!displacements.known) return []
  const box = tick("displacements", true, (on) => {
    displacements.object.visible = on
    scene.invalidate()
  })
  return [box, make("span", { className: "v-count" }, `exaggerated ${significant(displacements.factor, 1)} times, moved points in red`)]
}

/** The check box of the ellipsoids, and the slider of their exaggeration. */
function ellipsoidTools(model, scene) {
  const { ellipsoids } = scene
  if (!ellipsoids.known) return []
  const start = Math.log10((0.08 * scene.objectRadius) / ellipsoids.typical)
  const slider = make("input", { type: "range", min: 0, max: Math.max(1, start + 1.5), step: 0.01, value: start, disabled: true })
  slider.setAttribute("aria-label", "exaggeration of the ellipsoids")
  const told = make("span", { className: "v-count" })
  const change = () => {
    const factor = roundStep(10 ** Number(slider.value))
    ellipsoids.scale(factor)
    const some = ellipsoids.known > ellipsoids.shown.length ? `, only the ${MAX_ELLIPSOIDS} largest of ${ellipsoids.known}` : ""
    told.textContent = ellipsoids.object.visible ? `1 sigma, exaggerated ${significant(factor, 1)} times${some}` : ""
    scene.invalidate()
  }
  slider.addEventListener("input", change)
  const box = tick("error ellipsoids", false, (on) => {
    ellipsoids.object.visible = on
    slider.disabled = !on
    change()
  })
  return [box, slider, told]
}

function savePicture(scene, name) {
  const picture = pictureOf(scene).toDataURL("image/png")
  make("a", { href: picture, download: `${name.replace(/[^\w.-]+/g, "_")}.png` }).click()
}

/** A copy of scene and names: the browser keeps a drawn frame only until it is displayed. */
function pictureOf(scene) {
  scene.draw()
  const whole = make("canvas", { className: "v-printed", width: scene.canvas.width, height: scene.canvas.height })
  const context = whole.getContext("2d")
  context.drawImage(scene.canvas, 0, 0)
  context.drawImage(scene.overlay, 0, 0)
  return whole
}

const SUGGESTED = 12

function suggest(model, text, list) {
  const wanted = text.toLowerCase()
  const found = []
  for (const name of [...model.points, ...model.photographs]) {
    if (found.length === SUGGESTED) break
    if (name.toLowerCase().includes(wanted)) found.push(make("option", { value: name }))
  }
  list.replaceChildren(...found)
}

function findName(model, scene, hub, input) {
  const wanted = input.value.trim().toLowerCase()
  if (!wanted) return
  for (const exact of [true, false]) {
    for (const [kind, names] of [["point", model.points], ["photograph", model.photographs]]) {
      const index = names.findIndex((name) => (exact ? name.toLowerCase() === wanted : name.toLowerCase().includes(wanted)))
      if (index < 0) continue
      input.classList.remove("v-wrong")
      hub.tell("select", { kind, index })
      return
    }
  }
  input.classList.add("v-wrong")
}

function rmsWords(model, key, index) {
  return model.hasResiduals ? `, RMS ${significant(model.a[key][index])} px` : ""
}

function showHover(model, stage, box, { found, x, y }) {
  box.hidden = !found
  if (!found) return
  const { kind, index } = found
  if (kind === "point") {
    const s = model.sigma(index)
    const words = Number.isFinite(s) ? `${sigmaWords(s * model.fine.factor, model.fine.unit)}, ` : ""
    box.replaceChildren(make("b", {}, model.points[index]), ` ${words}${counted(model.a["point.rays"][index], "ray")}${rmsWords(model, "point.rms", index)}`)
  } else {
    const address = model.picture("thumbnail", index)
    const words = ` ${counted(model.a["photo.points"][index], "point")}${rmsWords(model, "photo.rms", index)}`
    box.replaceChildren(make("b", {}, model.photographs[index]), words)
    if (address) box.append(make("img", { src: address, alt: "", width: 160 }))
  }
  const left = x > stage.clientWidth / 2
  box.style.left = left ? "" : `${x + 14}px`
  box.style.right = left ? `${stage.clientWidth - x + 14}px` : ""
  box.style.top = y > stage.clientHeight / 2 ? "" : `${y + 10}px`
  box.style.bottom = y > stage.clientHeight / 2 ? `${stage.clientHeight - y + 10}px` : ""
}

start()
