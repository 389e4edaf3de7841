// The 3D scene: points, photographs, rays, ellipsoids, scale bars and control; rotated, picked from and measured in.

import * as THREE from "three"
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js"
import { Displacements } from "./displacements.js"
import { Ellipsoids } from "./ellipsoids.js"
import { drawLabels } from "./labels.js"
import { Picker } from "./picking.js"
import { Photographs, pyramidOf } from "./photographs.js"
import { MANY, Points } from "./points.js"
import { lines, Rays } from "./rays.js"

const FIELD_DEG = 40 // of the perspective camera
const STEP_RAD = 0.12 // rotation per press of an arrow key
const SLOW_MS = 36 // time between frames above which fewer points are drawn while the scene moves
const MAX_THIN = 16
const REST_MS = 250 // after which all points are drawn again
const FILLED = 0.9 // fraction of the canvas that a view fills
const SMALLEST = 1 / 3 // fraction of the canvas: below it, the first view shows the object only
const FAR_RADII = 1.5 // points more than this many object radii away do not widen a view
const NEIGHBOURS = 6 // nearest points shown around a selected one
const CLOSEST = 0.1 // of the object's radius: the smallest radius shown around a selected point
const BACKGROUND = { light: 0xf7f9fb, dark: 0x10151b }

export class Scene {
  constructor(model, canvas, overlay, hub) {
    Object.assign(this, { model, canvas, overlay, hub })
    this.place(model)
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: model.pointCount <= MANY && model.photoCount <= MANY / 20 })
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2))
    this.world = new THREE.Scene()
    this.world.add(new THREE.AmbientLight(0xffffff, 2), new THREE.DirectionalLight(0xffffff, 1.5))
    this.points = new Points(model, this.origin)
    this.photographs = new Photographs(model, this.origin, this.pyramid)
    this.rays = new Rays(model, this.origin)
    this.ellipsoids = new Ellipsoids(model, this.origin)
    this.displacements = new Displacements(model, this.origin, this.objectRadius)
    this.given = lines(this.barEnds(), "#e07b1a")
    this.control = this.controlMarks()
    this.distance = lines([], "#d4358b")
    this.distance.renderOrder = 2
    for (const part of [this.points, this.photographs, this.rays, this.ellipsoids, this.displacements]) this.world.add(part.object)
    this.world.add(this.given, this.control, this.distance)
    this.perspective = new THREE.PerspectiveCamera(FIELD_DEG, 1, this.radius / 1000, this.radius * 100)
    this.orthographic = new THREE.OrthographicCamera(-1, 1, 1, -1, -this.radius * 50, this.radius * 100)
    this.camera = this.perspective
    this.names = false
    this.picker = new Picker(this)
    this.begin()
    this.resize()
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement)
    this.listen()
  }

  /** Set origin, size and the up direction, which points from the object towards the photographs. */
  place(model) {
    const n = model.pointCount
    const middle = [0, 1, 2].map((c) => median(Array.from({ length: n }, (_, j) => model.xyz(j)[c])))
    this.origin = middle
    const lengths = Array.from({ length: n }, (_, j) => distanceOf(model.xyz(j), middle)).sort((a, b) => a - b)
    this.objectRadius = lengths[Math.floor(0.98 * (n - 1))] || 1
    const stations = Array.from({ length: model.photoCount }, (_, i) => distanceOf(model.centre(i), middle))
    const far = stations.sort((a, b) => a - b)[Math.floor(0.9 * (stations.length - 1))] || 0
    this.radius = Math.max(this.objectRadius, far)
    const places = (count, place) => Array.from({ length: count }, (_, k) => this.local(place(k)))
    this.object = places(n, (j) => model.xyz(j)).filter((p) => p.length() <= FAR_RADII * this.objectRadius)
    this.pyramid = 0.09 * (median(stations) || this.objectRadius) * Math.min(1, Math.sqrt(40 / model.photoCount))
    const near = Array.from({ length: model.photoCount }, (_, i) => i).filter((i) => distanceOf(model.centre(i), middle) <= FAR_RADII * this.radius)
    this.stations = near.flatMap((i) => pyramidOf(model, i, this.origin, this.pyramid))
    const towards = new THREE.Vector3()
    for (let i = 0; i < model.photoCount; i++) {
      const c = model.centre(i)
      const one = new THREE.Vector3(c[0] - middle[0], c[1] - middle[1], c[2] - middle[2])
      if (one.lengthSq() > 0) towards.add(one.normalize())
    }
    // Photographs all around an object give no up direction: use Z.
    this.up = towards.length() > 0.3 * model.photoCount ? towards.normalize() : new THREE.Vector3(0, 0, 1)
    const axis = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((v) => new THREE.Vector3(...v))
    const nearest = axis.find((v) => Math.abs(v.dot(this.up)) > 0.94)
    if (nearest) this.up = nearest.multiplyScalar(Math.sign(nearest.dot(this.up)))
  }

  barEnds() {
    const found = []
    for (const bar of this.model.bars) found.push(this.local(this.model.xyz(bar.from)), this.local(this.model.xyz(bar.to)))
    return found
  }

  controlMarks() {
    const size = 0.02 * this.objectRadius
    const ends = []
    for (const j of this.model.control) {
      const p = this.local(this.model.xyz(j))
      for (const axis of [[1, 0, 0], [0, 1, 0], [0, 0, 1]]) {
        const step = new THREE.Vector3(...axis).multiplyScalar(size)
        ends.push(p.clone().sub(step), p.clone().add(step))
      }
    }
    return lines(ends, "#e07b1a")
  }

  /** A position relative to the origin of the scene: map coordinates are too large for single precision. */
  local(xyz) {
    return new THREE.Vector3(xyz[0] - this.origin[0], xyz[1] - this.origin[1], xyz[2] - this.origin[2])
  }

  listen() {
    const canvas = this.canvas
    let pressed = null
    canvas.addEventListener("pointerdown", (event) => (pressed = [event.offsetX, event.offsetY]))
    canvas.addEventListener("pointerup", (event) => {
      const still = pressed && Math.hypot(event.offsetX - pressed[0], event.offsetY - pressed[1]) < 4
      pressed = null
      if (still) this.hub.tell("select", this.picker.at(event.offsetX, event.offsetY))
    })
    let waiting = false
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons || waiting) return
      waiting = true
      requestAnimationFrame(() => {
        waiting = false
        const found = this.picker.at(event.offsetX, event.offsetY)
        canvas.classList.toggle("v-over", found !== null)
        this.hub.tell("hover", { found, x: event.offsetX, y: event.offsetY })
      })
    })
    canvas.addEventListener("pointerleave", () => this.hub.tell("hover", { found: null }))
    canvas.addEventListener("keydown", (event) => this.key(event))
  }

  key(event) {
    const turns = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }
    if (turns[event.key]) this.turn(turns[event.key][0] * STEP_RAD, turns[event.key][1] * STEP_RAD)
    else if (event.key === "+" || event.key === "=") this.zoom(0.85)
    else if (event.key === "-") this.zoom(1 / 0.85)
    else if (event.key === "Home") this.begin()
    else return
    event.preventDefault()
  }

  /** Rotate the view about its centre, sideways and upwards, rad. */
  turn(side, upwards) {
    const { target } = this.controls
    const up = this.camera.up
    const offset = this.camera.position.clone().sub(target).applyAxisAngle(up, side)
    const across = new THREE.Vector3().crossVectors(up, offset).normalize()
    const turned = offset.clone().applyAxisAngle(across, upwards)
    if (new THREE.Vector3().crossVectors(up, turned).length() > 0.05 * turned.length()) offset.copy(turned)
    this.camera.position.copy(target).add(offset)
    this.controls.update()
    this.view = null
    this.moved()
  }

  zoom(factor) {
    if (this.camera.isOrthographicCamera) {
      this.camera.zoom /= factor
      this.camera.updateProjectionMatrix()
    } else {
      this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target)
    }
    this.controls.update()
    this.view = null
    this.invalidate()
  }

  /** Look along a direction so that the given positions, by default the object, fill the canvas. */
  look(direction, up, seen = this.object) {
    const from = direction.clone().normalize()
    const right = new THREE.Vector3().crossVectors(up, from).normalize()
    const upwards = new THREE.Vector3().crossVectors(from, right)
    const { clientWidth, clientHeight } = this.canvas.parentElement
    const high = Math.tan((FIELD_DEG / 2) * (Math.PI / 180)) * FILLED
    const wide = (high * Math.max(1, clientWidth)) / Math.max(1, clientHeight)
    const largest = (value) => seen.reduce((most, p) => Math.max(most, value(p)), -Infinity)
    const depth = (largest((p) => p.dot(from)) - largest((p) => -p.dot(from))) / 2
    // The planes through the edges of the canvas touch the outermost positions, in both directions.
    const [x, y] = [[right, wide], [upwards, high]].map(([axis, tangent]) => {
      const slope = this.camera.isOrthographicCamera ? 0 : tangent
      const most = (sign) => largest((p) => sign * p.dot(axis) + slope * (p.dot(from) - depth))
      return { middle: (most(1) - most(-1)) / 2, distance: (most(1) + most(-1)) / 2 / tangent }
    })
    const distance = Math.max(x.distance, y.distance, 1e-3 * this.objectRadius)
    const target = right.multiplyScalar(x.middle).addScaledVector(upwards, y.middle).addScaledVector(from, depth)
    for (const camera of [this.perspective, this.orthographic]) {
      camera.up.copy(up)
      camera.position.copy(from).multiplyScalar(distance).add(target)
    }
    this.orthographic.zoom = 1
    this.span = (distance * high) / FILLED
    this.view = { direction: from, up: up.clone(), seen }
    this.follow(target)
    this.frame()
  }

  follow(target) {
    this.controls?.dispose()
    this.controls = new OrbitControls(this.camera, this.canvas)
    this.controls.zoomToCursor = true
    this.controls.target.copy(target)
    this.controls.addEventListener("change", () => this.moved())
    this.controls.addEventListener("start", () => (this.view = null))
    this.controls.update()
    this.camera.updateMatrixWorld()
  }

  /** Show object and photographs, or the object only where it would be small among them; a plan shows both. */
  begin() {
    this.home([...this.object, ...this.stations])
    if (this.share() < SMALLEST && this.model.hasResiduals) this.home()
  }

  /** Fraction of the canvas that the object fills, along the side where it fills more. */
  share() {
    const places = this.object.map((p) => p.clone().project(this.camera))
    const range = (values) => values.reduce((most, v) => Math.max(most, v), -Infinity) + values.reduce((most, v) => Math.max(most, -v), -Infinity)
    return Math.max(range(places.map((p) => p.x)), range(places.map((p) => p.y))) / 2
  }

  /** Look obliquely from above at the given positions, by default the object. */
  home(seen) {
    const [a, b] = across(this.up)
    this.look(this.up.clone().multiplyScalar(0.75).add(a.multiplyScalar(-0.35)).add(b.multiplyScalar(-0.8)), this.up, seen)
  }

  standard(name) {
    const z = new THREE.Vector3(0, 0, 1)
    const views = {
      "+X": [[1, 0, 0], z], "-X": [[-1, 0, 0], z], "+Y": [[0, 1, 0], z], "-Y": [[0, -1, 0], z],
      "+Z": [[0, 0, 1], new THREE.Vector3(0, 1, 0)], "-Z": [[0, 0, -1], new THREE.Vector3(0, 1, 0)],
    }
    if (!views[name]) return this.home(name === "all" ? [...this.object, ...this.stations] : undefined)
    this.look(new THREE.Vector3(...views[name][0]), views[name][1])
  }

  setOrthographic(on) {
    const from = this.camera
    const target = this.controls.target.clone()
    this.camera = on ? this.orthographic : this.perspective
    this.camera.up.copy(from.up)
    this.camera.position.copy(from.position)
    const distance = from.position.distanceTo(target)
    const half = Math.tan((FIELD_DEG / 2) * (Math.PI / 180))
    if (on) {
      this.orthographic.zoom = this.span / (distance * half)
    } else {
      const away = from.position.clone().sub(target).normalize()
      this.camera.position.copy(target).addScaledVector(away, this.span / from.zoom / half)
    }
    this.follow(target)
    if (this.view) this.look(this.view.direction, this.view.up, this.view.seen)
    else this.frame()
  }

  /** Centre a position without rotating; zoom in until a radius around it fills the canvas, but never zoom out. */
  approach(target, radius) {
    const { clientWidth, clientHeight } = this.canvas
    const across = Math.min(clientWidth, clientHeight) * this.unitsPerPixel()
    const factor = Math.min(1, (2 * radius) / across)
    const offset = this.camera.position.clone().sub(this.controls.target)
    if (this.camera.isOrthographicCamera) this.camera.zoom /= factor
    else offset.multiplyScalar(factor)
    this.camera.position.copy(target).add(offset)
    this.view = null
    this.follow(target)
    this.camera.updateProjectionMatrix()
  }

  /** Radius around a position that contains its nearest neighbours. */
  surroundings(position) {
    const lengths = this.object.map((p) => p.distanceTo(position)).sort((a, b) => a - b)
    const near = lengths[Math.min(NEIGHBOURS, lengths.length - 1)] ?? 0
    return Math.max(near, CLOSEST * this.objectRadius)
  }

  /** Show the selection: centre a point and zoom in; zoom out to a photograph outside the view. */
  select(found) {
    this.selected = found
    this.points.select(found?.kind === "point" ? found.index : -1)
    this.photographs.select(found?.kind === "photograph" ? found.index : -1)
    this.rays.show(found)
    if (found?.kind === "point") {
      const position = this.local(this.model.xyz(found.index))
      this.approach(position, this.surroundings(position))
    } else if (found) {
      const station = this.local(this.model.centre(found.index))
      if (!this.sees(station)) this.look(this.camera.position.clone().sub(this.controls.target), this.camera.up.clone(), [...this.object, station])
    }
    this.invalidate()
  }

  /** Whether a position is on the canvas. */
  sees(position) {
    const at = this.project(position)
    return at !== null && at[0] >= 0 && at[1] >= 0 && at[0] <= this.canvas.clientWidth && at[1] <= this.canvas.clientHeight
  }

  /** Draw the line whose length is measured. */
  measure(i, j) {
    const ends = j >= 0 ? [this.local(this.model.xyz(i)), this.local(this.model.xyz(j))] : []
    this.distance.geometry.dispose()
    this.distance.geometry = new THREE.BufferGeometry().setFromPoints(ends)
    this.invalidate()
  }

  resize() {
    const box = this.canvas.parentElement.getBoundingClientRect()
    const [width, height] = [Math.max(1, Math.floor(box.width)), Math.max(1, Math.floor(box.height))]
    this.renderer.setSize(width, height)
    this.overlay.width = width * this.renderer.getPixelRatio()
    this.overlay.height = height * this.renderer.getPixelRatio()
    if (this.view) this.look(this.view.direction, this.view.up, this.view.seen)
    else this.frame()
  }

  /** Fit both cameras to the shape of the canvas. */
  frame() {
    const { clientWidth, clientHeight } = this.canvas.parentElement
    const aspect = Math.max(1, clientWidth) / Math.max(1, clientHeight)
    this.perspective.aspect = aspect
    const half = this.span
    Object.assign(this.orthographic, { left: -half * aspect, right: half * aspect, top: half, bottom: -half })
    this.perspective.updateProjectionMatrix()
    this.orthographic.updateProjectionMatrix()
    this.invalidate()
  }

  invalidate() {
    if (this.due) return
    this.due = true
    requestAnimationFrame(() => this.draw())
  }

  /** Draw soon: fewer points if all would take too long, and all of them once the view is at rest. */
  moved() {
    clearTimeout(this.rest)
    this.moving = true
    this.rest = setTimeout(() => {
      this.moving = false
      this.last = 0
      this.invalidate()
    }, REST_MS)
    this.invalidate()
  }

  /** Thin out the points until a frame takes no longer than allowed. */
  pace() {
    const now = performance.now()
    const took = this.last ? now - this.last : 0
    this.last = now
    if (!this.moving || this.model.pointCount < MANY) return this.setThin(1)
    this.mean = took ? 0.6 * (this.mean ?? took) + 0.4 * took : this.mean
    this.part ??= 1
    if (this.mean > SLOW_MS && this.part < MAX_THIN) {
      this.part *= 2
      this.mean = SLOW_MS / 2
    }
    this.setThin(this.part)
  }

  setThin(part) {
    this.points.thin(part)
    this.overlay.hidden = part > 2 // a second layer costs as much as thousands of points
    this.hub.tell("thin", part)
  }

  get dark() {
    return matchMedia("screen and (prefers-color-scheme: dark)").matches && !this.printing
  }

  draw() {
    this.due = false
    this.pace()
    const { dark } = this
    this.renderer.setClearColor(dark ? BACKGROUND.dark : BACKGROUND.light)
    this.points.setDark(dark)
    this.renderer.render(this.world, this.camera)
    if (!this.overlay.hidden) drawLabels(this, dark)
  }

  /** Canvas position of an object position, px; null behind the camera. */
  project(position) {
    const p = position.clone().project(this.camera)
    if (p.z > 1 || p.z < -1) return null
    const { clientWidth, clientHeight } = this.canvas
    return [((p.x + 1) / 2) * clientWidth, ((1 - p.y) / 2) * clientHeight]
  }

  /** Size of a pixel in the plane through the centre of the view, object unit. */
  unitsPerPixel() {
    if (this.camera.isOrthographicCamera) {
      return (this.camera.top - this.camera.bottom) / this.camera.zoom / this.canvas.clientHeight
    }
    const distance = this.camera.position.distanceTo(this.controls.target)
    return (2 * distance * Math.tan((FIELD_DEG / 2) * (Math.PI / 180))) / this.canvas.clientHeight
  }
}

function across(up) {
  const other = Math.abs(up.z) > 0.9 ? new THREE.Vector3(1, 0, 0) : new THREE.Vector3(0, 0, 1)
  const a = other.addScaledVector(up, -other.dot(up)).normalize()
  return [a, new THREE.Vector3().crossVectors(up, a)]
}

function median(values) {
  return values.sort((a, b) => a - b)[Math.floor(values.length / 2)] ?? 0
}

function distanceOf(a, b) {
  return Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2])
}
