// Values as colours on scales from the smallest value of the page to the largest.

import { roundStep, significant } from "./numbers.js"

// Viridis (Smith and van der Walt 2015): lightness follows the value, so it reads in grey too. Its darkest tenth is
// omitted, because it is invisible on a dark page.
const STEPS = [
  [72, 40, 120], [66, 64, 134], [54, 92, 141], [42, 118, 142], [33, 145, 140],
  [39, 173, 129], [92, 200, 99], [170, 220, 50], [253, 231, 37],
]
// Blue, grey, red for deviations, where neither sign is better (after Moreland 2009).
const SIGNED = [
  [33, 82, 196], [92, 134, 222], [150, 172, 214], [190, 190, 190], [226, 160, 130], [221, 100, 76], [178, 24, 43],
]
// The darker steps of viridis have less than 3 : 1 contrast with a dark page (WCAG 2.2, criterion 1.4.11).
const DARK_STEPS = STEPS.slice(3)
const UNKNOWN = [128, 134, 142]

/** A colour scale from one value to another, linear or logarithmic. */
export class Scale {
  constructor(name, unit, from, to, { log = false, factor = 1, reversed = false, signed = false } = {}) {
    Object.assign(this, { name, unit, from, to, log, factor, reversed, signed, dark: false })
  }

  /** Position of a value on the scale, 0 to 1. */
  place(value) {
    const of = this.log ? (x) => Math.log(Math.max(x, 1e-300)) : (x) => x
    return Math.min(1, Math.max(0, (of(value) - of(this.from)) / (of(this.to) - of(this.from))))
  }

  /** Red, green, blue of a value, 0 to 255. */
  colour(value) {
    return Number.isFinite(value) ? this.shade(this.place(value)) : UNKNOWN
  }

  /** Red, green, blue of a position on the scale. */
  shade(place) {
    const steps = this.signed ? SIGNED : this.dark ? DARK_STEPS : STEPS
    const at = (this.reversed ? 1 - place : place) * (steps.length - 1)
    const k = Math.min(steps.length - 2, Math.floor(at))
    return steps[k].map((low, c) => Math.round(low + (at - k) * (steps[k + 1][c] - low)))
  }

  /** Round values between the ends of the scale. */
  ticks() {
    const found = []
    if (this.log) {
      const wide = this.to / this.from > 20
      for (let power = 10 ** Math.floor(Math.log10(this.from)); power <= this.to * 1.001; power *= 10) {
        for (const step of wide ? [1] : [1, 2, 5]) found.push(step * power)
      }
    } else {
      const step = roundStep((1.001 * (this.to - this.from) * this.factor) / 3) / this.factor
      for (let k = Math.ceil(this.from / step - 1e-3); k * step <= this.to * 1.001; k++) found.push(k * step)
    }
    const slack = this.log ? 0 : 1e-3 * (this.to - this.from)
    return found.filter((x) => x >= this.from * (this.log ? 0.999 : 1) - slack && x <= this.to * (this.log ? 1.001 : 1) + slack)
  }

  words(value) {
    const shown = value * this.factor
    if (shown !== 0 && Math.abs(shown) < 1e-3) return shown.toExponential(1).replace(".0e", "e")
    return `${+significant(shown, 3)}`
  }
}

/** The colours that the photographs show, in place of a scale: the value of a point is its number. */
class Photographed {
  constructor(colours) {
    this.name = "colours of the photographs"
    this.colours = colours
  }

  colour(j) {
    return this.colours.subarray(3 * j, 3 * j + 3)
  }
}

/** Scales of the points. */
export function pointScales(model) {
  const sigma = Float64Array.from({ length: model.pointCount }, (_, j) => model.sigma(j))
  const known = sigma.filter((s) => s > 0)
  const { rays, rms, angle } = { rays: model.a["point.rays"], rms: model.a["point.rms"], angle: model.a["point.angle"] }
  const scales = {
    sigma: ratioScale("sigma of a point", model.fine.unit, known, { factor: model.fine.factor }),
    rays: equalScale("rays of a point", "", rays, { reversed: true }),
    rms: ratioScale("RMS residual of a point", "px", rms),
    angle: equalScale("intersection angle", "deg", angle, { reversed: true }),
  }
  const values = { sigma, rays, rms, angle }
  if (!known.length) delete scales.sigma
  if (!model.hasResiduals) delete scales.rms
  if (model.a["point.displacement"]) {
    const displacement = Float64Array.from({ length: model.pointCount }, (_, j) => model.displacement(j))
    const first = new Scale("displacement of a point", model.fine.unit, 0, largest(displacement), {
      factor: model.fine.factor,
    })
    return { scales: { displacement: first, ...scales }, values: { displacement, ...values } }
  }
  const deviation = model.a["point.deviation"]
  if (deviation) {
    const most = largest(deviation)
    const options = { factor: model.fine.factor, signed: true }
    const first = new Scale("deviation of a point", model.fine.unit, -most, most, options)
    return { scales: { deviation: first, ...scales }, values: { deviation, ...values } }
  }
  const colours = model.a["point.colour"]
  if (colours) {
    const numbers = Uint32Array.from({ length: model.pointCount }, (_, j) => j)
    return { scales: { photographed: new Photographed(colours), ...scales }, values: { photographed: numbers, ...values } }
  }
  return { scales, values }
}

/** The largest absolute value; 1 if all are 0, so that a scale has an extent. */
function largest(values) {
  return values.reduce((most, d) => (Math.abs(d) > most ? Math.abs(d) : most), 0) || 1
}

/** The scale of the photographs; null if they have no residuals. */
export function photoScale(model) {
  return model.hasResiduals ? ratioScale("RMS residual of a photograph", "px", model.a["photo.rms"]) : null
}

/** A logarithmic scale from the smallest value above 0 to the largest. */
function ratioScale(name, unit, values, { factor = 1 } = {}) {
  const [from, to] = ends(values.filter((x) => x > 0 && Number.isFinite(x)), [0.1, 1])
  return new Scale(name, unit, from, to > from ? to : 2 * from, { log: true, factor })
}

/** A linear scale from the smallest value to the largest. */
function equalScale(name, unit, values, options) {
  const [from, to] = ends(values.filter(Number.isFinite), [0, 1])
  return new Scale(name, unit, from, to > from ? to : from + 1, options)
}

/** The smallest and the largest of values; the others if there are none. */
function ends(values, others) {
  if (!values.length) return others
  return values.reduce(([low, high], x) => [Math.min(low, x), Math.max(high, x)], [Infinity, -Infinity])
}

/** Draw a scale with its labels and with fields for its limits. */
export function drawLegend(scale, element, make, onchange) {
  if (scale instanceof Photographed) {
    element.replaceChildren(make("div", { className: "v-legend-name" }, scale.name))
    return
  }
  const bar = make("canvas", { width: 240, height: 1, className: "v-bar" })
  const context = bar.getContext("2d")
  for (let x = 0; x < bar.width; x++) {
    const part = x / (bar.width - 1)
    context.fillStyle = `rgb(${scale.shade(part).join()})`
    context.fillRect(x, 0, 1, 1)
  }
  const ticks = make("div", { className: "v-ticks" })
  const shown = [scale.from, scale.to].map((value) => scale.words(value)) // beside the bar
  for (const value of scale.ticks().filter((tick) => !shown.includes(scale.words(tick)))) {
    const label = make("span", {}, scale.words(value))
    label.style.left = `${100 * scale.place(value)}%`
    ticks.append(label)
  }
  const end = (key, words) => {
    const input = make("input", {
      className: "v-end",
      value: scale.words(scale[key]),
      "aria-label": `${words} of the scale: ${scale.name}`,
    })
    input.addEventListener("change", () => {
      const typed = Number(input.value) / scale.factor
      const other = scale[key === "from" ? "to" : "from"]
      const sound = Number.isFinite(typed) && (key === "from" ? typed < other : typed > other)
      if (sound && !(scale.log && typed <= 0)) scale[key] = typed
      onchange()
    })
    return input
  }
  const unit = scale.unit ? ` [${scale.unit}]` : ""
  element.replaceChildren(
    make("div", { className: "v-legend-name" }, scale.name + unit),
    make("div", { className: "v-legend-row" }, end("from", "lower limit"), make("div", { className: "v-scale" }, bar, ticks), end("to", "upper limit")),
  )
}
