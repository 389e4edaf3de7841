// The filmstrip: every photograph with its state. Arrow keys move along it, Enter shows a photograph in the active pane.

import { make } from "../page.js"
import { counted } from "../numbers.js"

const THUMBNAIL_LEVEL = 8 // of the deep zoom pyramid: at most 256 px, one tile

export class Strip {
  constructor(model, element, show) {
    Object.assign(this, { model, element, show, frames: [] })
    element.addEventListener("keydown", (event) => this.key(event))
  }

  /** Take over a new state, and which photographs the panes show. */
  refresh(shown, active) {
    const { photographs } = this.model.state
    if (this.frames.length !== photographs.length) {
      this.frames = photographs.map((photograph) => this.frame(photograph))
      this.element.replaceChildren(...this.frames.map((frame) => frame.button))
    }
    photographs.forEach((photograph, image) => {
      const { button, told } = this.frames[image]
      const proposals = this.model.measured(this.model.proposals.get(image) ?? []).length
      const state = this.model.stateOf(image)
      const words = `${state.words}, ${counted(photograph.marks, "mark")}${proposals ? `, ${counted(proposals, "proposal")}` : ""}`
      told.replaceChildren(
        make("span", { className: state.look }, state.words),
        ` ${photograph.marks}`,
        proposals ? make("span", { className: "m-blue" }, ` +${proposals}`) : "",
      )
      button.title = `${photograph.name}: ${photograph.changed ?? words}`
      button.setAttribute("aria-label", `${photograph.name}: ${photograph.changed ?? words}`)
      button.classList.toggle("m-shown", shown.includes(image))
      if (image === active) button.setAttribute("aria-current", "true")
      else button.removeAttribute("aria-current")
      button.tabIndex = image === (this.reached ?? active) ? 0 : -1
    })
  }

  frame({ index, name, width, height }) {
    const level = Math.min(THUMBNAIL_LEVEL, Math.ceil(Math.log2(Math.max(width, height))))
    const picture = make("img", { src: `tiles/${index}_files/${level}/0_0.jpg`, alt: "", loading: "lazy", decoding: "async" })
    const told = make("span", { className: "m-state" })
    const button = make("button", { type: "button", className: "m-frame", onclick: () => this.show(index) }, picture, make("span", { className: "m-name" }, name), told)
    return { button, told }
  }

  key(event) {
    const steps = { ArrowLeft: -1, ArrowRight: 1, Home: -Infinity, End: Infinity }
    if (!(event.key in steps)) return
    const from = this.frames.findIndex(({ button }) => button === document.activeElement)
    this.reached = Math.min(this.frames.length - 1, Math.max(0, from + steps[event.key]))
    this.frames.forEach(({ button }, image) => (button.tabIndex = image === this.reached ? 0 : -1))
    this.frames[this.reached].button.focus()
    event.preventDefault()
    event.stopPropagation()
  }

  reveal(image) {
    this.reached = null
    this.frames[image]?.button.scrollIntoView({ block: "nearest", inline: "nearest" })
  }
}
