// The object under the pointer: a few pixels of the scene are drawn again, in colours that encode indices.

import * as THREE from "three"
import { CORNERS } from "./photographs.js"
import { material } from "./points.js"

const WINDOW_PX = 11 // side of the window drawn; the object nearest to its middle is picked
const EXTRA_PX = 4 // added to the size of points when picking

export class Picker {
  constructor(scene) {
    this.scene = scene
    const { points, photographs, model } = scene
    const n = model.pointCount
    const geometry = new THREE.BufferGeometry()
    geometry.setAttribute("position", points.geometry.getAttribute("position"))
    geometry.setAttribute("color", new THREE.BufferAttribute(numbers(n, 1, 1), 3, true))
    geometry.setAttribute("size", new THREE.BufferAttribute(new Float32Array(n).fill(points.size + EXTRA_PX), 1))
    const pyramids = new THREE.BufferGeometry()
    pyramids.setAttribute("position", photographs.geometry.getAttribute("position"))
    pyramids.setAttribute("color", new THREE.BufferAttribute(numbers(model.photoCount, n + 1, CORNERS), 3, true))
    pyramids.setIndex(photographs.faces.index)
    this.points = new THREE.Points(geometry, material(true))
    this.pyramids = new THREE.Mesh(pyramids, undefined)
    this.pyramids.material = new THREE.ShaderMaterial({
      vertexColors: true,
      side: THREE.DoubleSide,
      vertexShader:
        "varying vec3 vId; void main() { vId = color; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }",
      fragmentShader: "varying vec3 vId; void main() { gl_FragColor = vec4(vId, 1.0); }",
    })
    this.world = new THREE.Scene()
    this.world.add(this.points, this.pyramids)
    this.target = new THREE.WebGLRenderTarget(WINDOW_PX, WINDOW_PX)
    this.pixels = new Uint8Array(4 * WINDOW_PX * WINDOW_PX)
  }

  /** Return the point or photograph at a position on the canvas, or null. */
  at(x, y) {
    const { renderer, camera, canvas, photographs } = this.scene
    const half = (WINDOW_PX - 1) / 2
    this.pyramids.visible = photographs.object.visible
    camera.setViewOffset(canvas.clientWidth, canvas.clientHeight, x - half, y - half, WINDOW_PX, WINDOW_PX)
    renderer.setRenderTarget(this.target)
    renderer.setClearColor(0)
    renderer.clear()
    renderer.render(this.world, camera)
    renderer.readRenderTargetPixels(this.target, 0, 0, WINDOW_PX, WINDOW_PX, this.pixels)
    renderer.setRenderTarget(null)
    camera.clearViewOffset()
    let best = [Infinity, 0]
    for (let k = 0; k < WINDOW_PX * WINDOW_PX; k++) {
      const [r, g, b] = this.pixels.subarray(4 * k, 4 * k + 3)
      const number = r + 256 * g + 65536 * b
      const away = Math.hypot((k % WINDOW_PX) - half, Math.floor(k / WINDOW_PX) - half)
      // Points are small, so they take precedence over a pyramid around the pointer.
      const rank = number > this.scene.model.pointCount ? away + WINDOW_PX : away
      if (number && rank < best[0]) best = [rank, number]
    }
    if (!best[1]) return null
    const n = this.scene.model.pointCount
    return best[1] > n ? { kind: "photograph", index: best[1] - n - 1 } : { kind: "point", index: best[1] - 1 }
  }
}

/** Colours that encode the integers from `first` on, each repeated for so many corners. */
function numbers(count, first, corners) {
  const found = new Uint8Array(3 * count * corners)
  for (let k = 0; k < count * corners; k++) {
    const number = first + Math.floor(k / corners)
    found.set([number & 255, (number >> 8) & 255, (number >> 16) & 255], 3 * k)
  }
  return found
}
