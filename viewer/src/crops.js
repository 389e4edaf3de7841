// Enlarged crops of the photographs around a measured target, with centre, ellipse and exaggerated residual vector.

import { make } from "./page.js"
import { roundStep, signed, significant } from "./numbers.js"

const SIDE_PX = 150 // of a crop on the page
const ARROW_PART = 0.25 // of the side: length of a residual vector of the size of the RMS
export const GREEN = "#2fd06f"
export const RED = "#ff4d42"
export const YELLOW = "#ffc81a"

/** Exaggeration of residual vectors: one as long as the RMS is drawn with this length in px. */
export function arrowFactor(model, length) {
  return model.rms_px > 0 ? roundStep(length / model.rms_px) : 1
}

/** A crop with its caption, or the caption alone if there is no picture. */
export function cropCard(model, k, hub, factor) {
  const i = model.a["ray.photo"][k]
  const j = model.a["ray.point"][k]
  const [vx, vy] = model.pair("ray.v", k)
  const [wx, wy] = model.pair("ray.w", k)
  const [x, y] = model.pair("ray.xy", k)
  const card = make("figure", { className: model.rejected(k) ? "v-crop v-rejected" : "v-crop" })
  card.dataset.ray = k
  const crop = model.cropOfRay.get(k)
  if (crop !== undefined) card.append(drawn(model, k, crop, factor))
  else card.append(make("div", { className: "v-nocrop" }, model.notes.no_crop))
  const known = Number.isFinite(wx)
  card.append(
    make(
      "figcaption",
      {},
      make("a", { href: "#explore", onclick: (event) => go(event, hub, i) }, model.photographs[i]),
      make("br"),
      `x ${x.toFixed(2)}, y ${y.toFixed(2)} px`,
      make("br"),
      `v ${signed(vx, 3)}, ${signed(vy, 3)} px`,
      make("br"),
      known ? `w ${signed(wx, 2)}, ${signed(wy, 2)}` : "w not known",
      model.rejected(k) ? make("b", {}, " rejected") : null,
    ),
  )
  card.title = `${model.points[j]} in ${model.photographs[i]}`
  return card
}

function go(event, hub, i) {
  event.preventDefault()
  hub.tell("select", { kind: "photograph", index: i })
}

function drawn(model, k, crop, factor) {
  const canvas = make("canvas", { width: 2 * SIDE_PX, height: 2 * SIDE_PX, className: "v-crop-picture" })
  const [left, top, side] = model.a["crop.frame"].subarray(4 * crop, 4 * crop + 3)
  const scale = canvas.width / side
  const context = canvas.getContext("2d")
  const lay = () => {
    const at = ([u, v]) => [(u - left) * scale, (v - top) * scale]
    drawTarget(context, model, k, at, scale, factor)
    canvas.dataset.ready = "1"
  }
  const picture = new Image()
  picture.onload = () => {
    context.imageSmoothingEnabled = false
    const [sx, sy, s] = model.cropCell(crop)
    context.drawImage(picture, sx, sy, s, s, 0, 0, canvas.width, canvas.height)
    lay()
  }
  picture.onerror = () => {
    canvas.replaceWith(make("div", { className: "v-nocrop" }, model.notes.no_file))
  }
  picture.src = model.cropAddress(crop)
  canvas.setAttribute("role", "img")
  canvas.setAttribute("aria-label", `${model.photographs[model.a["ray.photo"][k]]}, ${Math.round(side)} px wide`)
  return canvas
}

/** Draw ellipse, measured centre and residual vector of a ray; `at` converts pixels to canvas positions. */
export function drawTarget(context, model, k, at, scale, factor, { width = 2 } = {}) {
  const xy = model.pair("ray.xy", k)
  const [a, b, angle] = model.a["ray.ellipse"].subarray(3 * k, 3 * k + 3)
  const v = model.pair("ray.v", k)
  const [x, y] = at(xy)
  context.lineWidth = width
  context.strokeStyle = model.rejected(k) ? RED : GREEN
  context.beginPath()
  if (a > 0) context.ellipse(x, y, a * scale, b * scale, angle, 0, 2 * Math.PI)
  const arm = Math.max(3, 3 * width)
  context.moveTo(x - arm, y)
  context.lineTo(x + arm, y)
  context.moveTo(x, y - arm)
  context.lineTo(x, y + arm)
  context.stroke()
  if (!Number.isFinite(v[0])) return
  context.strokeStyle = YELLOW
  context.lineWidth = 1.5 * width
  context.beginPath()
  context.moveTo(x, y)
  context.lineTo(...at([xy[0] + factor * v[0], xy[1] + factor * v[1]]))
  context.stroke()
}

/** Exaggeration of the residual vectors in the crops of rays; 0 if there are no crops. */
export function cropFactor(model, rays) {
  const sides = rays.filter((k) => model.cropOfRay.has(k)).map((k) => model.a["crop.frame"][4 * model.cropOfRay.get(k) + 2])
  if (!sides.length) return 0
  return arrowFactor(model, ARROW_PART * sides.sort((a, b) => a - b)[sides.length >> 1])
}

export function cropLegend(factor) {
  if (!factor) return ""
  return `Green: measured centre and fitted ellipse (red: rejected). Yellow: residual vector v (computed minus measured), exaggerated ${significant(factor, 1)} times. Each crop is 2.2 target diameters wide.`
}
