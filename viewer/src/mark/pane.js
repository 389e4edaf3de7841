// A photograph in a pane: OpenSeadragon shows its tiles, a canvas above them what is marked.

import OpenSeadragon from "openseadragon"
import { button, make } from "../page.js"
import { counted } from "../numbers.js"
import { drawOverlay } from "./drawing.js"

const TILES_CACHED = 240 // of all panes, about 1 MB each
const SHARP = 3 // magnification from which single pixels are shown
const CURSOR_STEP = 10 // px of the screen, of the crosshair that the arrow keys move
const EDGE = 40 // px of the screen, from which the view follows the crosshair
const NEAR = 9 // px of the screen within which a click chooses what is marked or proposed there
const DOUBLE_MS = 400 // between the clicks of a double click
const GESTURES = { clickToZoom: false, dblClickToZoom: false, dblClickDragToZoom: false, flickEnabled: false }

export class Pane {
  /** @param actions of {click, choose, hover, activate, show}: what the page does on gestures in a pane. */
  constructor(model, number, count, actions) {
    Object.assign(this, { model, number, image: null, actions, pending: [], sight: [], cursor: null, options: {} })
    this.stage = make("div", { className: "m-stage" })
    this.canvas = make("canvas", { className: "m-overlay", "aria-hidden": "true" })
    this.warning = make("p", { className: "m-warning bad", hidden: true })
    this.choice = make("select", { "aria-label": `photograph in pane ${number + 1}` })
    this.choice.addEventListener("change", () => actions.show(this, Number(this.choice.value)))
    this.told = make("span", { className: "m-told" })
    this.view = make("div", { className: "m-view", tabIndex: 0, role: "application" }, this.stage, this.canvas, this.warning)
    this.element = make(
      "section",
      { className: "m-pane" },
      make("header", {}, this.choice, this.told, button("fit", () => this.fit(), { title: "show the whole photograph (f)" })),
      this.view,
    )
    this.viewer = OpenSeadragon({
      element: this.stage,
      drawer: "canvas", // smooth at 24 megapixels, and in browsers without WebGL
      showNavigationControl: false,
      keyboardNavEnabled: false,
      tabIndex: -1,
      animationTime: 0.2,
      visibilityRatio: 0.2,
      minZoomImageRatio: 0.8,
      maxZoomPixelRatio: 40,
      smoothTileEdgesMinZoom: Infinity,
      maxImageCacheCount: Math.ceil(TILES_CACHED / count),
      maxTilesPerFrame: 4,
      tileRetryMax: 100, // until the program answers again
      clickTimeThreshold: 60_000, // a person who aims presses long
      clickDistThreshold: 4,
      gestureSettingsMouse: GESTURES,
      gestureSettingsTouch: GESTURES,
      gestureSettingsPen: GESTURES,
      gestureSettingsUnknown: GESTURES,
    })
    this.viewer.innerTracker.keyHandler = null
    this.viewer.innerTracker.keyDownHandler = null
    this.listen()
  }

  listen() {
    const { viewer, view, actions } = this
    viewer.addHandler("canvas-click", (event) => {
      event.preventDefaultAction = true
      if (!event.quick || this.isAgain(event.position)) return
      const place = this.placeAt(event.position.x, event.position.y)
      const there = event.shift ? null : this.pointAt(event.position.x, event.position.y)
      if (there !== null && there !== this.model.pointFor(this.image)) actions.choose(this, there)
      else if (this.contains(place)) actions.click(this, place, event.shift)
    })
    viewer.addHandler("update-viewport", () => {
      const { viewport } = viewer
      if (this.whole && Math.abs(viewport.getZoom() / viewport.getHomeZoom() - 1) > 1e-6) viewport.goHome(true)
      else if (this.ready) this.view.dataset.ready = String(this.image)
      this.draw()
    })
    viewer.addHandler("open", () => this.opened())
    for (const gesture of ["canvas-drag", "canvas-scroll", "canvas-pinch"]) viewer.addHandler(gesture, () => (this.whole = false))
    viewer.addHandler("open-failed", () => this.warn("The photograph cannot be shown."))
    viewer.addHandler("tile-load-failed", () => this.warn("A part of the photograph cannot be shown."))
    view.addEventListener("focusin", () => actions.activate(this))
    view.addEventListener("pointerdown", () => {
      view.focus({ preventScroll: true })
      actions.activate(this)
    }, { capture: true })
    view.addEventListener("pointermove", (event) => {
      const box = view.getBoundingClientRect()
      this.point(this.placeAt(event.clientX - box.left, event.clientY - box.top), false)
    }, { capture: true })
    view.addEventListener("pointerleave", () => this.leave())
    view.addEventListener("blur", () => this.cursor?.keyboard && this.leave())
    view.addEventListener("keydown", (event) => this.key(event))
    this.observer = new ResizeObserver(() => this.resize())
    this.observer.observe(view)
  }

  close() {
    this.observer.disconnect()
    this.viewer.destroy()
    this.element.remove()
  }

  /** Show a photograph, and the place in it that is asked for. */
  show(image, place = null) {
    this.goal = place
    if (image === this.image) {
      if (place) this.centre(place)
      return
    }
    Object.assign(this, { image, cursor: null, sight: [], ready: false })
    delete this.view.dataset.ready
    this.warning.hidden = true
    this.viewer.open(`tiles/${image}.dzi`)
    this.refresh()
  }

  opened() {
    this.ready = true
    this.whole = true // until the person moves or zooms it: then it stays whole when the pane changes its size
    this.viewer.viewport.goHome(true)
    if (this.goal) this.centre(this.goal)
    this.resize()
  }

  warn(sentence) {
    this.warning.textContent = this.model.photograph(this.image)?.changed ?? sentence
    this.warning.hidden = false
  }

  /** Take over a new state. */
  refresh() {
    const { photographs } = this.model.state
    const photograph = photographs[this.image]
    if (this.choice.length !== photographs.length) {
      this.choice.replaceChildren(...photographs.map(({ name, index }) => make("option", { value: index }, name)))
    }
    this.choice.value = this.image
    if (photograph.changed) this.warn(photograph.changed)
    const { words, look } = this.model.stateOf(this.image)
    this.told.textContent = `${words}${photograph.needs && !photograph.oriented ? " more" : ""}, ${counted(photograph.marks, "mark")}`
    this.told.className = `m-told ${look}`
    this.view.setAttribute("aria-label", `${photograph.name}, ${this.told.textContent}; arrow keys move the crosshair, Space measures, plus and minus zoom`)
    this.draw()
  }

  resize() {
    const ratio = Math.min(window.devicePixelRatio, 2)
    const { clientWidth, clientHeight } = this.view
    const size = [Math.round(clientWidth * ratio), Math.round(clientHeight * ratio)]
    if (this.canvas.width !== size[0] || this.canvas.height !== size[1]) [this.canvas.width, this.canvas.height] = size
    this.ratio = ratio
    this.draw()
  }

  /** The mapping from the pixel frame, whose origin is the centre of the top-left pixel, to the canvas. */
  frame() {
    const { viewport } = this.viewer
    const { width } = this.model.photograph(this.image)
    const corner = (x, y) => viewport.pixelFromPoint(new OpenSeadragon.Point(x, y), true)
    const [origin, right, below] = [corner(0, 0), corner(1, 0), corner(0, 1)]
    const [ux, uy] = [(right.x - origin.x) / width, (right.y - origin.y) / width]
    const [vx, vy] = [(below.x - origin.x) / width, (below.y - origin.y) / width]
    const scale = Math.hypot(ux, uy)
    const direction = ([x, y]) => [(x * ux + y * vx) / scale, (x * uy + y * vy) / scale]
    const at = ([x, y]) => [origin.x + (x + 0.5) * ux + (y + 0.5) * vx, origin.y + (x + 0.5) * uy + (y + 0.5) * vy]
    const det = ux * vy - uy * vx
    const back = (left, top) => {
      const [p, q] = [left - origin.x, top - origin.y]
      return [(p * vy - q * vx) / det - 0.5, (q * ux - p * uy) / det - 0.5]
    }
    return { at, back, direction, scale, turn: Math.atan2(uy, ux), width: this.view.clientWidth, height: this.view.clientHeight }
  }

  placeAt(left, top) {
    return this.ready ? this.frame().back(left, top) : null
  }

  contains(place) {
    const { width, height } = this.model.photograph(this.image)
    return Boolean(place) && place[0] >= -0.5 && place[1] >= -0.5 && place[0] <= width - 0.5 && place[1] <= height - 0.5
  }

  /** Whether a click is the second one of a double click, which is meant as one. */
  isAgain({ x, y }) {
    const [before, now] = [this.clicked, performance.now()]
    this.clicked = { x, y, now }
    return Boolean(before) && now - before.now < DOUBLE_MS && Math.hypot(x - before.x, y - before.y) < NEAR
  }

  /** The point that is marked or proposed at a place of the canvas, or null. */
  pointAt(left, top) {
    const { at } = this.frame()
    let nearest = { away: NEAR, point: null }
    const { marks, proposals } = this.model
    for (const { x, y, point } of [...(marks.get(this.image) ?? []), ...(proposals.get(this.image) ?? [])]) {
      const [u, v] = at([x, y])
      const away = Math.hypot(u - left, v - top)
      if (away < nearest.away) nearest = { away, point }
    }
    return nearest.point
  }

  draw() {
    if (!this.ready || !this.model.state || !this.ratio) return
    const frame = this.frame()
    const sharp = frame.scale >= SHARP
    if (this.sharp !== sharp) {
      this.sharp = sharp
      this.viewer.drawer.setImageSmoothingEnabled(!sharp)
    }
    const context = this.canvas.getContext("2d")
    context.setTransform(this.ratio, 0, 0, this.ratio, 0, 0)
    context.clearRect(0, 0, frame.width, frame.height)
    const { pending, sight, cursor } = this
    drawOverlay(context, frame, this.model, this.image, { ...this.options, pending, sight, cursor: cursor && { ...cursor, text: this.actions.words(this) } })
  }

  /** The pointer, or the crosshair of the keyboard, is at a place. */
  point(place, keyboard) {
    if (!this.contains(place)) return this.leave()
    this.cursor = { place, keyboard }
    this.actions.hover(this, place)
    this.draw()
  }

  leave() {
    if (!this.cursor) return
    this.cursor = null
    this.actions.hover(this, null)
    this.draw()
  }

  key(event) {
    const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }
    if (event.ctrlKey || event.metaKey || event.altKey || !this.ready) return
    if (moves[event.key]) this.moveCursor(moves[event.key], event.shiftKey ? 1 : CURSOR_STEP)
    else if (event.key === " ") this.actions.click(this, this.crosshair(), event.shiftKey)
    else if (event.key === "+" || event.key === "=") this.zoom(1.5)
    else if (event.key === "-") this.zoom(1 / 1.5)
    else return
    event.preventDefault()
    event.stopPropagation()
  }

  /** The place of the crosshair; the middle of the view if there is none. */
  crosshair() {
    const { clientWidth, clientHeight } = this.view
    return this.cursor?.place ?? this.placeAt(clientWidth / 2, clientHeight / 2)
  }

  moveCursor([u, v], step) {
    const frame = this.frame()
    const keyboard = this.cursor?.keyboard
    let [left, top] = frame.at(this.crosshair())
    if (keyboard) [left, top] = [left + u * step, top + v * step] // the first key only shows where it is
    const place = frame.back(left, top)
    const outside = left < EDGE || top < EDGE || left > frame.width - EDGE || top > frame.height - EDGE
    if (outside) this.whole = false
    if (outside) this.viewer.viewport.panTo(this.viewportPoint(place), false)
    this.point(place, true)
  }

  viewportPoint([x, y]) {
    const { width } = this.model.photograph(this.image)
    return new OpenSeadragon.Point((x + 0.5) / width, (y + 0.5) / width)
  }

  zoom(factor) {
    this.whole = false
    this.viewer.viewport.zoomBy(factor, this.viewportPoint(this.crosshair()))
    this.viewer.viewport.applyConstraints()
  }

  /** Show a place large: at least as large as the pixels of the screen. */
  centre(place) {
    this.goal = null
    if (!this.ready) {
      this.goal = place
      return
    }
    this.whole = false
    const { viewport } = this.viewer
    const wanted = viewport.imageToViewportZoom(2)
    if (viewport.getZoom() < wanted) viewport.zoomTo(wanted, null, true)
    viewport.panTo(this.viewportPoint(place), true)
    this.draw()
  }

  fit() {
    this.whole = true
    if (this.ready) this.viewer.viewport.goHome()
  }

  turn() {
    this.viewer.viewport.setRotation(this.viewer.viewport.getRotation() + 90, true)
  }
}
