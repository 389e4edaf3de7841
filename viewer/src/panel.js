// The selection in words and pictures: a point with its crops, or a photograph with its targets.

import { cropCard, cropFactor, cropLegend } from "./crops.js"
import { button, facts, make } from "./page.js"
import { fixed, sigmaWords, significant, toPrecision } from "./numbers.js"
import { PhotographView } from "./photoview.js"

const MAX_CROPS = 60 // cards at once; more are shown on demand

export class Panel {
  constructor(model, element, hub, scene) {
    Object.assign(this, { model, element, hub, scene, from: -1 })
    hub.on("select", (found) => this.show(found))
    this.show(null)
  }

  show(found) {
    this.view?.close()
    this.view = null
    if (!found) this.empty()
    else if (found.kind === "point") this.point(found.index)
    else this.photograph(found.index)
    this.element.scrollTop = 0
  }

  empty() {
    this.element.replaceChildren(
      make("h3", { className: "v-hint" }, "Nothing selected"),
      make("p", { className: "v-hint" }, "Click a point or a photograph in the scene, or a row in the tables below."),
      make(
        "p",
        { className: "note v-hint" },
        "Drag or arrow keys: rotate. Wheel, + or -: zoom. Right button or two fingers: pan. Home: reset the view. Escape: clear the selection.",
      ),
      ...this.model.notes.page.map((words) => make("p", { className: "note" }, words)),
    )
  }

  point(j) {
    const model = this.model
    const { unit } = model
    const s = model.sigmas(j)
    const [x, y, z] = model.xyz(j)
    const rays = [...model.raysOfPoint(j)].sort((a, b) => order(model, b) - order(model, a))
    const rejected = rays.filter((k) => model.rejected(k)).length
    const coordinates = [x, y, z].map((v, c) => [
      "XYZ"[c],
      `${toPrecision(v, s[c])} ${unit}, ${sigmaWords(s[c] * model.fine.factor, model.fine.unit)}`,
    ])
    const factor = cropFactor(model, rays)
    const cards = make("div", { className: "v-crops" })
    const add = (from) => {
      rays.slice(from, from + MAX_CROPS).forEach((k) => cards.append(cropCard(model, k, this.hub, factor)))
      const left = rays.length - from - MAX_CROPS
      if (left > 0) {
        const more = button(`show ${left} more`, () => {
          more.remove()
          add(from + MAX_CROPS)
        })
        cards.append(more)
      }
    }
    add(0)
    this.element.replaceChildren(
      make("h3", { className: "v-title" }, `Point ${model.points[j]}`),
      facts([
        ...coordinates,
        ["rays", `${rays.length - rejected} accepted${rejected ? `, ${rejected} rejected` : ""}`],
        ["intersection angle", `${fixed(model.a["point.angle"][j], 1)} deg`],
        model.hasResiduals ? ["RMS residual", `${fixed(model.a["point.rms"][j], 4)} px`] : null,
        Number.isFinite(model.a["point.deviation"]?.[j]) ? ["deviation", `${fixed(model.a["point.deviation"][j] * model.fine.factor, 4)} ${model.fine.unit}`] : null,
        model.a["point.displacement"] && Number.isFinite(model.displacement(j)) ? ["displacement", this.displacementWords(j)] : null,
        model.control.includes(j) ? ["role", "control point"] : null,
      ]),
      this.distance(j),
      make("h4", {}, "Image points, largest |w| first"),
      make("p", { className: "note" }, cropLegend(factor)),
      cards,
    )
  }

  /** Length and components of the displacement of a point, and the result of its test. */
  displacementWords(j) {
    const { model } = this
    const { factor, unit } = model.fine
    const parts = [0, 1, 2].map((c) => fixed(model.a["point.displacement"][3 * j + c] * factor, 2))
    const state = model.states[model.a["point.state"][j]]
    return `${fixed(model.displacement(j) * factor, 2)} ${unit} (${parts.join(", ")})${state ? `, ${state}` : ""}`
  }

  /** The distance between this point and another, and the button that starts a measurement. */
  distance(j) {
    const model = this.model
    const box = make("div", { className: "v-distance" })
    const from = this.from
    if (from >= 0 && from !== j) {
      box.append(...this.distanceWords(from, j))
      this.scene.measure(from, j)
      this.from = -1
    } else if (from < 0) this.scene.measure(-1, -1)
    const begin = button("Measure a distance from here", () => {
      this.from = j
      begin.replaceWith(make("p", { className: "v-prompt" }, `Now select the other point (from ${model.points[j]}).`))
    })
    box.append(begin)
    return box
  }

  distanceWords(i, j) {
    const model = this.model
    const a = model.xyz(i)
    const b = model.xyz(j)
    const d = Math.hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2])
    const joint = model.distanceSigma(i, j)
    const alone = model.distanceSigmaAlone(i, j)
    const sigma = Number.isFinite(joint) ? joint : alone
    const fine = (v) => `${significant(v * model.fine.factor)} ${model.fine.unit}`
    const words = Number.isFinite(joint)
      ? `sigma ${fine(joint)}, from the joint covariance of all points.`
      : Number.isFinite(alone)
        ? `sigma ${fine(alone)}, from the separate covariances of the two points: ${model.notes.covariance}`
        : "No standard deviation: the result has no covariances."
    const step = [0, 1, 2].map((c) => `d${"XYZ"[c]} ${toPrecision(b[c] - a[c], sigma)}`).join(", ")
    return [
      make("h4", {}, `${model.points[i]} \u2013 ${model.points[j]}`),
      make("p", { className: "v-length" }, make("b", {}, `${toPrecision(d, sigma)} ${model.unit}`), ` ${words}`),
      make("p", { className: "note" }, `${step} ${model.unit}`),
    ]
  }

  photograph(i) {
    const model = this.model
    const [x, y, z] = model.centre(i)
    const s = model.a["photo.sigma"].subarray(6 * i, 6 * i + 6)
    const angles = model.a["photo.angles"].subarray(3 * i, 3 * i + 3)
    const rays = model.raysOfPhoto(i)
    const rejected = rays.filter((k) => model.rejected(k)).length
    const pair = (value, sigma, unit, { factor, unit: fine } = { factor: 1, unit }) =>
      `${toPrecision(value, sigma)} ${unit}${sigma > 0 ? `, sigma ${significant(sigma * factor)} ${fine}` : ""}`
    this.view = new PhotographView(model, i, this.hub)
    this.element.replaceChildren(
      make("h3", { className: "v-title" }, `Photograph ${model.photographs[i]}`),
      this.view.element,
      facts([
        ["camera", model.camera(i).name],
        ...[x, y, z].map((v, c) => [`${"XYZ"[c]}0`, pair(v, s[c], model.unit, model.fine)]),
        ...["omega", "phi", "kappa"].map((name, c) => [name, pair(angles[c], s[3 + c], "deg")]),
        ["image points", `${rays.length - rejected} accepted${rejected ? `, ${rejected} rejected` : ""}`],
        model.hasResiduals ? ["RMS residual", `${fixed(model.a["photo.rms"][i], 4)} px`] : null,
      ]),
      this.view.reasons(),
    )
    this.view.resize()
  }
}

/** Rejected rays first, then by |w|, then by the length of the residual. */
function order(model, k) {
  const w = model.worstW(k)
  return (model.rejected(k) ? 1e9 : 0) + (Number.isFinite(w) ? w : model.residual(k))
}
