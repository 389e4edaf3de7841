// The object points as discs of constant size, coloured by a value.

import * as THREE from "three"

const SIZES_PX = [[500, 9], [2000, 6], [Infinity, 4]] // up to this many points, at this size
export const MANY = 5000 // more points than this are drawn as small squares without a rim
const SIZE_OF_MANY_PX = 3

const VERTEX = `
attribute float size;
varying vec3 vShade;
uniform float ratio;
void main() {
  vShade = color;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
  gl_PointSize = size * ratio;
}`
const SQUARE = "varying vec3 vShade; void main() { gl_FragColor = vec4(vShade, 1.0); }"
const FRAGMENT = `
varying vec3 vShade;
uniform bool flat_;
uniform vec3 rim;
void main() {
  float r = length(gl_PointCoord - 0.5);
  if (r > 0.5) discard;
  gl_FragColor = vec4(!flat_ && r > 0.43 ? mix(vShade, rim, 0.4) : vShade, 1.0);
}`

export class Points {
  constructor(model, origin) {
    const n = model.pointCount
    const position = new Float32Array(3 * n)
    for (let k = 0; k < 3 * n; k++) position[k] = model.a["point.xyz"][k] - origin[k % 3]
    this.size = n > MANY ? SIZE_OF_MANY_PX : SIZES_PX.find(([most]) => n <= most)[1]
    this.geometry = new THREE.BufferGeometry()
    this.geometry.setAttribute("position", new THREE.BufferAttribute(position, 3))
    this.geometry.setAttribute("color", new THREE.BufferAttribute(new Uint8Array(3 * n), 3, true))
    this.geometry.setAttribute("size", new THREE.BufferAttribute(new Float32Array(n).fill(this.size), 1))
    this.geometry.setIndex(new THREE.BufferAttribute(shuffled(n), 1)) // so that any subset covers the whole object
    this.object = new THREE.Points(this.geometry, material(false, n > MANY))
    this.chosen = -1
  }

  /** Draw one point in `part`. */
  thin(part) {
    this.geometry.setDrawRange(0, Math.ceil(this.geometry.index.count / part))
  }

  paint(values, scale) {
    const colours = this.geometry.getAttribute("color")
    for (let j = 0; j < values.length; j++) colours.array.set(scale.colour(values[j]), 3 * j)
    colours.needsUpdate = true
  }

  setDark(dark) {
    this.object.material.uniforms.rim.value.set(dark ? 0xffffff : 0x000000)
  }

  select(index) {
    const sizes = this.geometry.getAttribute("size")
    if (this.chosen >= 0) sizes.array[this.chosen] = this.size
    if (index >= 0) sizes.array[index] = 2 * this.size
    this.chosen = index
    sizes.needsUpdate = true
  }
}

/** Discs with a rim; flat ones for picking, or squares. */
export function material(flat, square = false) {
  return new THREE.ShaderMaterial({
    vertexShader: VERTEX,
    fragmentShader: square ? SQUARE : FRAGMENT,
    vertexColors: true,
    uniforms: { rim: { value: new THREE.Color(0) }, ratio: { value: flat ? 1 : Math.min(window.devicePixelRatio, 2) }, flat_: { value: flat } },
  })
}

/** The integers from 0 on in a pseudo-random order that is always the same. */
function shuffled(count) {
  const order = Uint32Array.from({ length: count }, (_, k) => k)
  let state = 1
  for (let k = count - 1; k > 0; k--) {
    state = (Math.imul(state, 1664525) + 1013904223) >>> 0
    const other = state % (k + 1)
    ;[order[k], order[other]] = [order[other], order[k]]
  }
  return order
}
