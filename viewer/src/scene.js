// The scene in space: points, photographs, rays, ellipsoids, scale bars and control; turned, picked, measured.

import * as THREE from "three"
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js"
import { Displacements } from "./displacements.js"
import { Ellipsoids } from "./ellipsoids.js"
import { drawLabels } from "./labels.js"
import { Picker } from "./picking.js"
import { Photographs } from "./photographs.js"
import { MANY, Points } from "./points.js"
import { lines, Rays } from "./rays.js"

const FIELD_DEG = 40 // of the perspective camera
const STEP_RAD = 0.12 // that an arrow key turns
const SLOW_MS = 36 // from frame to frame: then fewer points are drawn while the scene turns
const MAX_THIN = 16
const REST_MS = 250 // after which all points are drawn again

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
    this.home()
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement)
    this.listen()
    this.resize()
  }

  /** Choose origin, size and the direction that is up: from the object towards the photographs. */
  place(model) {
    const n = model.pointCount
    const middle = [0, 1, 2].map((c) => median(Array.from({ length: n }, (_, j) => model.xyz(j)[c])))
    this.origin = middle
    const lengths = Array.from({ length: n }, (_, j) => distanceOf(model.xyz(j), middle)).sort((a, b) => a - b)
    this.objectRadius = lengths[Math.floor(0.98 * (n - 1))] || 1
    const stations = Array.from({ length: model.photoCount }, (_, i) => distanceOf(model.centre(i), middle))
    const far = stations.sort((a, b) => a - b)[Math.floor(0.9 * (stations.length - 1))] || 0
    this.radius = Math.max(this.objectRadius, far)
    this.middle = this.middleOfAll(model)
    this.pyramid = 0.09 * (median(stations) || this.objectRadius) * Math.min(1, Math.sqrt(40 / model.photoCount))
    const towards = new THREE.Vector3()
    for (let i = 0; i < model.photoCount; i++) {
      const c = model.centre(i)
      const one = new THREE.Vector3(c[0] - middle[0], c[1] - middle[1], c[2] - middle[2])
      if (one.lengthSq() > 0) towards.add(one.normalize())
    }
    // Photographs all around an object say nothing of what is up: then it is Z.
    this.up = towards.length() > 0.3 * model.photoCount ? towards.normalize() : new THREE.Vector3(0, 0, 1)
    const axis = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((v) => new THREE.Vector3(...v))
    const near = axis.find((v) => Math.abs(v.dot(this.up)) > 0.94)
    if (near) this.up = near.multiplyScalar(Math.sign(near.dot(this.up)))
  }

  /** Middle of the box around points and photographs, and the radius about it. */
  middleOfAll(model) {
    const box = new THREE.Box3()
    for (let j = 0; j < model.pointCount; j++) {
      const p = this.local(model.xyz(j))
      if (p.length() <= this.objectRadius) box.expandByPoint(p)
    }
    for (let i = 0; i < model.photoCount; i++) {
      const p = this.local(model.centre(i))
      if (p.length() <= this.radius) box.expandByPoint(p)
    }
    this.allRadius = box.isEmpty() ? this.radius : 0.5 * box.getSize(new THREE.Vector3()).length()
    return box.isEmpty() ? new THREE.Vector3() : box.getCenter(new THREE.Vector3())
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

  /** A position relative to the origin of the scene: single precision bears no map coordinates. */
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
    else if (event.key === "Home") this.home()
    else return
    event.preventDefault()
  }

  /** Turn the view about its centre by angles to the side and upwards, rad. */
  turn(side, upwards) {
    const { target } = this.controls
    const up = this.camera.up
    const offset = this.camera.position.clone().sub(target).applyAxisAngle(up, side)
    const across = new THREE.Vector3().crossVectors(up, offset).normalize()
    const turned = offset.clone().applyAxisAngle(across, upwards)
    if (new THREE.Vector3().crossVectors(up, turned).length() > 0.05 * turned.length()) offset.copy(turned)
    this.camera.position.copy(target).add(offset)
    this.controls.update()
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
    this.invalidate()
  }

  /** Look at the centre from a direction, so that everything is seen. */
  look(direction, up, target = this.middle.clone(), radius = this.allRadius) {
    const { clientWidth, clientHeight } = this.canvas.parentElement
    const narrow = Math.max(1, clientHeight / Math.max(1, clientWidth))
    const distance = (narrow * radius) / Math.sin((FIELD_DEG / 2) * (Math.PI / 180))
    for (const camera of [this.perspective, this.orthographic]) {
      camera.up.copy(up)
      camera.position.copy(direction).normalize().multiplyScalar(distance).add(target)
    }
    this.orthographic.zoom = 1
    this.span = radius
    this.follow(target)
    this.resize()
  }

  follow(target) {
    this.controls?.dispose()
    this.controls = new OrbitControls(this.camera, this.canvas)
    this.controls.zoomToCursor = true
    this.controls.target.copy(target)
    this.controls.addEventListener("change", () => this.moved())
    this.controls.update()
  }

  home() {
    const [a, b] = across(this.up)
    this.look(this.up.clone().multiplyScalar(0.75).add(a.multiplyScalar(-0.35)).add(b.multiplyScalar(-0.8)), this.up)
  }

  standard(name) {
    const z = new THREE.Vector3(0, 0, 1)
    const views = {
      "+X": [[1, 0, 0], z], "-X": [[-1, 0, 0], z], "+Y": [[0, 1, 0], z], "-Y": [[0, -1, 0], z],
      "+Z": [[0, 0, 1], new THREE.Vector3(0, 1, 0)], "-Z": [[0, 0, -1], new THREE.Vector3(0, 1, 0)],
    }
    if (!views[name]) return this.home()
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
    this.resize()
  }

  /** Bring a position to the middle without turning; closer where the view is a wide one. */
  centre(xyz) {
    const target = this.local(xyz)
    const step = target.clone().sub(this.controls.target)
    this.camera.position.add(step)
    this.follow(target)
    this.invalidate()
  }

  select(found) {
    this.selected = found
    this.points.select(found?.kind === "point" ? found.index : -1)
    this.photographs.select(found?.kind === "photograph" ? found.index : -1)
    this.rays.show(found)
    this.invalidate()
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
    const aspect = width / height
    this.perspective.aspect = aspect
    const half = this.span * (aspect < 1 ? 1 / aspect : 1)
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

  /** Draw soon, with fewer points where all of them would take too long, and all when the view is at rest. */
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

  /** Draw one point in so many that a frame takes no longer than it may. */
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

  draw() {
    this.due = false
    this.pace()
    const dark = matchMedia("screen and (prefers-color-scheme: dark)").matches && !this.printing
    this.renderer.setClearColor(dark ? 0x10151b : 0xf7f9fb)
    this.points.setDark(dark)
    this.renderer.render(this.world, this.camera)
    if (!this.overlay.hidden) drawLabels(this, dark)
  }

  /** Where on the canvas a position is seen, px; null behind the camera. */
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
