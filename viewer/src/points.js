// The object points as discs of constant size, coloured by a value.

import * as THREE from "three"

const SIZE_PX = 7
const MANY = 5000 // more points than this are drawn smaller
const SIZE_OF_MANY_PX = 4

const VERTEX = `
attribute float size;
varying vec3 vShade;
uniform float ratio;
void main() {
  vShade = color;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
  gl_PointSize = size * ratio;
}`
const FRAGMENT = `
varying vec3 vShade;
uniform bool flat_;
void main() {
  float r = length(gl_PointCoord - 0.5);
  if (r > 0.5) discard;
  gl_FragColor = vec4(!flat_ && r > 0.42 ? vShade * 0.55 : vShade, 1.0);
}`

export class Points {
  constructor(model, origin) {
    const n = model.pointCount
    const position = new Float32Array(3 * n)
    for (let k = 0; k < 3 * n; k++) position[k] = model.a["point.xyz"][k] - origin[k % 3]
    this.size = n > MANY ? SIZE_OF_MANY_PX : SIZE_PX
    this.geometry = new THREE.BufferGeometry()
    this.geometry.setAttribute("position", new THREE.BufferAttribute(position, 3))
    this.geometry.setAttribute("color", new THREE.BufferAttribute(new Uint8Array(3 * n), 3, true))
    this.geometry.setAttribute("size", new THREE.BufferAttribute(new Float32Array(n).fill(this.size), 1))
    this.object = new THREE.Points(this.geometry, material(false))
    this.chosen = -1
  }

  paint(values, scale) {
    const colours = this.geometry.getAttribute("color")
    for (let j = 0; j < values.length; j++) colours.array.set(scale.colour(values[j]), 3 * j)
    colours.needsUpdate = true
  }

  select(index) {
    const sizes = this.geometry.getAttribute("size")
    if (this.chosen >= 0) sizes.array[this.chosen] = this.size
    if (index >= 0) sizes.array[index] = 2 * this.size
    this.chosen = index
    sizes.needsUpdate = true
  }
}

export function material(flat) {
  return new THREE.ShaderMaterial({
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    vertexColors: true,
    uniforms: { ratio: { value: flat ? 1 : Math.min(window.devicePixelRatio, 2) }, flat_: { value: flat } },
  })
}
