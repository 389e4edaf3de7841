// A photograph with targets, residual vectors and rejected candidates; wheel and pointer zoom and pan it.

import { arrowFactor, drawTarget, GREEN, RED } from "./crops.js"
import { button, make, tick } from "./page.js"
import { significant, signed } from "./numbers.js"

const ARROW_PX = 16 // length on the page of a residual of the size of the RMS
const MARK = "#5ab4ff"
const MAX_ZOOM = 40
const NEAR_PX = 12 // distance from the pointer within which an image point is described and selected
const MANY = 150 // candidates of one reason; more than this are hidden at first
const CELL_PX = 14 // names in the same cell would overlap

export class PhotographView {
  constructor(model, i, hub) {
    Object.assign(this, { model, i, hub, zoom: 1, offset: [0, 0], names: true, vectors: true })
    this.counts = new Map()
    for (const k of model.marksOfPhoto(i)) {
      const reason = model.a["mark.reason"][k]
      this.counts.set(reason, (this.counts.get(reason) ?? 0) + 1)
    }
    this.hidden = new Set([...this.counts].filter(([, count]) => count > MANY).map(([reason]) => reason))
    const camera = model.camera(i)
    this.size = [camera.width, camera.height]
    this.canvas = make("canvas", { className: "v-photo", tabIndex: 0 })
    this.canvas.setAttribute("aria-label", `Photograph ${model.photographs[i]}; + and - zoom, arrow keys pan`)
    this.told = make("p", { className: "v-told", "aria-live": "polite" })
    const again = () => this.draw()
    this.element = make(
      "div",
      { className: "v-photo-box" },
      make(
        "div",
        { className: "v-tools" },
        button("+", () => this.enlarge(1.5), { title: "zoom in" }),
        button("\u2212", () => this.enlarge(1 / 1.5), { title: "zoom out" }),
        button("fit", () => this.fit(), { title: "show the whole photograph" }),
        tick("names", this.names, (on) => (this.names = on) | again()),
        tick("residuals", this.vectors, (on) => (this.vectors = on) | again()),
        button("wide", () => this.widen(), { title: "more space for the photograph, less for the scene" }),
      ),
      this.canvas,
      this.told,
    )
    this.tell(null)
    this.listen()
    this.load()
    this.observer = new ResizeObserver(() => this.resize())
    this.observer.observe(this.element)
  }

  /** Show the embedded picture at once, then a larger one beside the page as soon as it is loaded. */
  load() {
    const embedded = this.model.picture("view", this.i)
    const beside = this.model.files[this.i]
    const small = embedded || this.model.picture("thumbnail", this.i)
    const show = (address, last) => {
      const picture = new Image()
      picture.onload = () => {
        this.picture = picture
        this.draw()
      }
      picture.onerror = () => {
        if (last && !this.picture) this.missing = this.model.notes.no_file
        this.draw()
      }
      picture.src = address
    }
    if (small) show(small, !beside)
    if (beside) show(beside, true)
    else if (!small) this.missing = this.model.notes.no_picture
  }

  close() {
    this.observer.disconnect()
  }

  resize() {
    const width = this.element.clientWidth
    if (!width) return
    const ratio = Math.min(window.devicePixelRatio, 2)
    this.fitScale = Math.min(width / this.size[0], (0.62 * window.innerHeight) / this.size[1])
    this.canvas.width = Math.round(this.size[0] * this.fitScale * ratio)
    this.canvas.height = Math.round(this.size[1] * this.fitScale * ratio)
    this.canvas.style.width = `${this.canvas.width / ratio}px`
    this.canvas.style.height = `${this.canvas.height / ratio}px`
    this.ratio = ratio
    this.draw()
  }

  get scale() {
    return this.fitScale * this.zoom
  }

  /** Canvas position of a position in the pixel frame, whose origin is the centre of a pixel. */
  at([x, y]) {
    return [(x + 0.5) * this.scale + this.offset[0], (y + 0.5) * this.scale + this.offset[1]]
  }

  draw() {
    if (!this.fitScale) return
    const context = this.canvas.getContext("2d")
    const [w, h] = [this.size[0] * this.fitScale, this.size[1] * this.fitScale]
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0)
    context.fillStyle = "#20262e"
    context.fillRect(0, 0, w, h)
    if (this.picture) {
      context.imageSmoothingEnabled = this.scale * (this.size[0] / this.picture.naturalWidth) < 4
      context.drawImage(this.picture, ...this.offset, this.size[0] * this.scale, this.size[1] * this.scale)
    } else if (this.missing) {
      context.fillStyle = "#c9d1da"
      context.fillText(this.missing, 10, 20)
    }
    const model = this.model
    this.drawMarks(context)
    const at = (xy) => this.at(xy)
    const factor = this.vectors ? arrowFactor(model, ARROW_PX / this.fitScale) / this.zoom : 0
    const rays = model.raysOfPhoto(this.i)
    const taken = new Set()
    context.font = "12px system-ui, sans-serif"
    for (const k of rays) {
      const [x, y] = this.at(model.pair("ray.xy", k))
      if (x < -50 || y < -50 || x > w + 50 || y > h + 50) continue
      drawTarget(context, model, k, at, this.scale, factor, { width: 1.2 })
      const text = model.points[model.a["ray.point"][k]]
      const cells = [0, 1, 2, 3].map((c) => `${Math.floor((x + c * CELL_PX) / CELL_PX)},${Math.floor(y / CELL_PX)}`)
      if (this.names && !cells.some((cell) => taken.has(cell))) {
        cells.forEach((cell) => taken.add(cell))
        context.strokeStyle = "rgba(0,0,0,.75)"
        context.lineWidth = 3
        context.strokeText(text, x + 8, y - 6)
        context.fillStyle = model.rejected(k) ? RED : GREEN
        context.fillText(text, x + 8, y - 6)
      }
    }
    const first = !this.factor && factor
    this.factor = factor
    if (first) this.tell(null)
    this.canvas.dataset.ready = this.picture ? "1" : ""
  }

  drawMarks(context) {
    context.strokeStyle = MARK
    context.lineWidth = 1.2
    context.beginPath()
    for (const k of this.shownMarks()) {
      const [x, y] = this.at(this.model.pair("mark.xy", k))
      context.moveTo(x - 3, y - 3)
      context.lineTo(x + 3, y + 3)
      context.moveTo(x - 3, y + 3)
      context.lineTo(x + 3, y - 3)
    }
    context.stroke()
  }

  shownMarks() {
    return this.model.marksOfPhoto(this.i).filter((k) => !this.hidden.has(this.model.a["mark.reason"][k]))
  }

  /** Check boxes that show the candidates that were not used, by reason. */
  reasons() {
    if (!this.counts.size) return ""
    const box = make("div", { className: "v-reasons" }, make("h4", {}, "Detected but not used (blue)"))
    for (const [reason, count] of [...this.counts].sort((a, b) => a[1] - b[1])) {
      const change = (on) => {
        if (on) this.hidden.delete(reason)
        else this.hidden.add(reason)
        this.draw()
      }
      box.append(tick(`${this.model.reasons[reason]}: ${count}`, !this.hidden.has(reason), change))
    }
    return box
  }

  widen() {
    this.element.closest(".v-main").classList.toggle("v-wide")
  }

  /** The image point or candidate nearest to a position on the canvas. */
  nearest(x, y) {
    let best = { away: NEAR_PX }
    const look = (kind, rows, name) => {
      for (const k of rows) {
        const [u, v] = this.at(this.model.pair(name, k))
        const away = Math.hypot(u - x, v - y)
        if (away < best.away) best = { away, kind, k }
      }
    }
    look("ray", this.model.raysOfPhoto(this.i), "ray.xy")
    look("mark", this.shownMarks(), "mark.xy")
    return best.kind ? best : null
  }

  tell(found) {
    const model = this.model
    let words = `Green: accepted, red: rejected, blue: detected but not used, yellow: residual vector${this.factor ? `, exaggerated ${significant(this.factor, 2)} times` : ""}.`
    if (found?.kind === "ray") {
      const k = found.k
      const v = model.pair("ray.v", k)
      const w = model.worstW(k)
      words = `${model.points[model.a["ray.point"][k]]}: v ${signed(v[0], 3)}, ${signed(v[1], 3)} px${Number.isFinite(w) ? `, |w| ${w.toFixed(2)}` : ""}${model.rejected(k) ? ", rejected in the adjustment" : ""}`
    } else if (found) {
      const [x, y] = model.pair("mark.xy", found.k)
      words = `x ${x.toFixed(1)}, y ${y.toFixed(1)} px: ${model.reasons[model.a["mark.reason"][found.k]]}`
    }
    this.told.textContent = words
  }

  listen() {
    const canvas = this.canvas
    let last = null
    let moved = false
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault()
      this.enlarge(event.deltaY < 0 ? 1.25 : 0.8, event.offsetX, event.offsetY)
    }, { passive: false })
    canvas.addEventListener("pointerdown", (event) => {
      last = [event.clientX, event.clientY]
      moved = false
      canvas.setPointerCapture(event.pointerId)
    })
    canvas.addEventListener("pointermove", (event) => {
      if (!last) return this.tell(this.nearest(event.offsetX, event.offsetY))
      const step = [event.clientX - last[0], event.clientY - last[1]]
      moved ||= Math.hypot(...step) > 3
      if (!moved) return
      last = [event.clientX, event.clientY]
      this.move(...step)
    })
    canvas.addEventListener("pointerup", (event) => {
      const found = moved ? null : this.nearest(event.offsetX, event.offsetY)
      last = null
      if (found?.kind === "ray") this.hub.tell("select", { kind: "point", index: this.model.a["ray.point"][found.k] })
      else if (found) this.tell(found)
    })
    canvas.addEventListener("dblclick", () => this.fit())
    canvas.addEventListener("keydown", (event) => {
      const moves = { ArrowLeft: [40, 0], ArrowRight: [-40, 0], ArrowUp: [0, 40], ArrowDown: [0, -40] }
      if (moves[event.key]) this.move(...moves[event.key])
      else if (event.key === "+" || event.key === "=") this.enlarge(1.5)
      else if (event.key === "-") this.enlarge(1 / 1.5)
      else if (event.key === "Home") this.fit()
      else return
      event.preventDefault()
      event.stopPropagation()
    })
  }

  enlarge(factor, x = this.canvas.clientWidth / 2, y = this.canvas.clientHeight / 2) {
    const zoom = Math.min(MAX_ZOOM, Math.max(1, this.zoom * factor))
    const change = zoom / this.zoom
    this.offset = [x - (x - this.offset[0]) * change, y - (y - this.offset[1]) * change]
    this.zoom = zoom
    this.move(0, 0)
  }

  /** Move the picture, within the limits of the canvas. */
  move(dx, dy) {
    const size = [this.size[0] * this.fitScale, this.size[1] * this.fitScale]
    this.offset = [dx, dy].map((d, c) => Math.min(0, Math.max(size[c] * (1 - this.zoom), this.offset[c] + d)))
    this.draw()
    this.tell(null)
  }

  fit() {
    this.zoom = 1
    this.offset = [0, 0]
    this.draw()
    this.tell(null)
  }
}
