// The photographs as pyramids: apex at the projection centre, base in the shape of the format, along the viewing direction.

import * as THREE from "three"

const EDGES = [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1, 5, 6]
const CORNERS = 7 // apex, four of the base, two of the mark on its upper side
const FACES = [0, 1, 2, 0, 2, 3, 0, 3, 4, 0, 4, 1, 1, 3, 2, 1, 4, 3]

export class Photographs {
  constructor(model, origin, size) {
    this.model = model
    const m = model.photoCount
    const position = new Float32Array(3 * CORNERS * m)
    const edges = new Uint32Array(EDGES.length * m)
    const faces = new Uint32Array(FACES.length * m)
    for (let i = 0; i < m; i++) {
      position.set(corners(model, i, origin, size), 3 * CORNERS * i)
      edges.set(EDGES.map((k) => k + CORNERS * i), EDGES.length * i)
      faces.set(FACES.map((k) => k + CORNERS * i), FACES.length * i)
    }
    this.geometry = new THREE.BufferGeometry()
    this.geometry.setAttribute("position", new THREE.BufferAttribute(position, 3))
    this.geometry.setAttribute("color", new THREE.BufferAttribute(new Uint8Array(3 * CORNERS * m), 3, true))
    this.geometry.setIndex(new THREE.BufferAttribute(edges, 1))
    this.faces = new THREE.BufferGeometry()
    this.faces.setAttribute("position", this.geometry.getAttribute("position"))
    this.faces.setIndex(new THREE.BufferAttribute(faces, 1))
    this.object = new THREE.Group()
    this.object.add(new THREE.LineSegments(this.geometry, new THREE.LineBasicMaterial({ vertexColors: true })))
    this.chosenFaces = new THREE.BufferGeometry()
    this.chosenFaces.setAttribute("position", this.geometry.getAttribute("position"))
    this.chosenFaces.setIndex([])
    const fill = { color: "#1f77e0", transparent: true, opacity: 0.35, side: THREE.DoubleSide, depthWrite: false }
    this.object.add(new THREE.Mesh(this.chosenFaces, new THREE.MeshBasicMaterial(fill)))
    this.chosen = -1
  }

  paint(values, scale) {
    const colours = this.geometry.getAttribute("color")
    for (let i = 0; i < values.length; i++) {
      const colour = scale ? scale.colour(values[i]) : [110, 120, 135]
      for (let k = 0; k < CORNERS; k++) colours.array.set(colour, 3 * (CORNERS * i + k))
    }
    colours.needsUpdate = true
  }

  select(index) {
    this.chosen = index
    this.chosenFaces.setIndex(index < 0 ? [] : FACES.map((k) => k + CORNERS * index))
  }
}

/** Positions of the corners of the pyramid of a photograph. */
export function pyramidOf(model, i, origin, size) {
  const all = corners(model, i, origin, size)
  return Array.from({ length: CORNERS }, (_, k) => new THREE.Vector3(...all.slice(3 * k, 3 * k + 3)))
}

function corners(model, i, origin, size) {
  const camera = model.camera(i)
  const R = model.rotation(i)
  const centre = model.centre(i)
  const half = camera.width / 2
  const high = camera.height / 2
  const k = size / Math.hypot(half, high)
  const depth = -camera.c_px
  const inImage = [
    [0, 0, 0],
    [-half, high, depth], [half, high, depth], [half, -high, depth], [-half, -high, depth],
    [-0.3 * half, high, depth], [0, 1.35 * high, depth],
  ]
  return inImage.flatMap((p) =>
    [0, 1, 2].map((r) => centre[r] - origin[r] + k * (R[3 * r] * p[0] + R[3 * r + 1] * p[1] + R[3 * r + 2] * p[2])),
  )
}

export { CORNERS, FACES }
