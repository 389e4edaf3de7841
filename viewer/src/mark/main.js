// The page of `kolinear mark`: photographs side by side, what is marked in them, and what is to be done next.

import { button, choice, Hub, make, tick } from "../page.js"
import { counted, significant } from "../numbers.js"
import { ask } from "./dialogs.js"
import { keysOf, listenToKeys, showHelp } from "./keys.js"
import { KINDS, Model } from "./model.js"
import { Pane } from "./pane.js"
import { Panel } from "./panel.js"
import { Server } from "./server.js"
import { Strip } from "./strip.js"

const LAYOUTS = [1, 2, 4, 6] // photographs side by side
const LIGHT_STEP = 1.15 // factor of brightness and contrast of a key
const LIGHT_LIMIT = 8
const SIGHT_MS = 40 // between two requests for rays of sight

class Page {
  constructor(root) {
    this.root = root
    this.hub = new Hub()
    this.model = new Model(this.hub)
    this.server = new Server(this.hub)
    this.panes = []
    this.active = 0
    this.shown = { names: true, residuals: true }
    this.lights = { brightness: 1, contrast: 1 }
    this.keys = keysOf(this)
    this.next = make("p", { id: "m-next", role: "status" })
    this.told = make("p", { id: "m-said", role: "status" })
    this.lost = make("p", { id: "m-lost", className: "bad", role: "alert", hidden: true })
    this.run = make("div", { id: "m-run" })
    this.title = make("h1", {}, "Marking")
    this.tools = make("div", { className: "v-tools", role: "toolbar", "aria-label": "tools" })
    this.grid = make("main", { id: "m-panes" })
    this.side = make("aside", { id: "m-side", "aria-label": "points and adjustment" })
    const film = make("nav", { id: "m-strip", "aria-label": "filmstrip" })
    this.strip = new Strip(this.model, film, (image) => this.showIn(this.pane, image))
    root.replaceChildren(make("header", { id: "m-head" }, this.title, this.next, this.run), this.lost, this.tools, this.told, this.grid, film, this.side)
    this.hub.on("state", (state) => this.take(state))
    this.hub.on("lost", (sentence) => this.lose(sentence))
    this.hub.on("back", () => this.regain())
    this.hub.on("chosen", () => this.refresh())
    listenToKeys(this.keys)
  }

  get pane() {
    return this.panes[this.active]
  }

  // ---- what the program tells

  take(state) {
    const first = this.model.state === null
    this.model.take(state)
    if (first) this.begin(state)
    document.title = `${state.name} - marking - Kolinear`
    this.next.textContent = state.next
    this.refreshRun()
    this.panel.refresh()
    this.refresh()
    this.root.dataset.version = state.version
  }

  begin(state) {
    this.title.textContent = state.name
    this.panel = new Panel(this.model, this.side, this.hub, {
      choose: (name) => this.model.choose(name),
      open: (place) => this.showIn(this.pane, place.image, [place.x, place.y]),
      openWorst: () => this.openWorst(),
      rename: () => this.rename(),
      control: () => this.control(),
      remove: () => this.remove(),
      accept: () => this.accept(),
      refuse: () => this.refuse(),
      bar: () => this.bar(),
      removeBar: ({ start, end }) => this.change("bar", { start, end, remove: true }, `Bar ${start} \u2013 ${end} deleted.`),
    })
    this.makeTools()
    this.layOut(Math.min(2, state.photographs.length))
  }

  lose(sentence) {
    this.lost.textContent = sentence
    this.lost.hidden = false
  }

  regain() {
    this.lost.hidden = true
    for (const pane of this.panes) pane.warning.hidden = true
    this.refresh()
  }

  refresh() {
    const { model } = this
    for (const pane of this.panes) {
      pane.options = this.shown
      pane.refresh()
    }
    this.strip.refresh(this.panes.map((pane) => pane.image), this.pane.image)
    for (const [name, key] of [["undo", "Z"], ["redo", "Shift+Z"]]) {
      const change = model.state[name]
      this.buttons[name].disabled = !change
      this.buttons[name].title = change ? `${key}: ${change.what}${this.server.made(change) ? "" : ", made by another page"}` : key
    }
    this.aim.textContent = model.chosen ?? "new point"
    this.buttons.fresh.setAttribute("aria-pressed", String(model.chosen === null))
    const measured = model.measured(model.state.proposals).length
    this.buttons.all.disabled = !measured
    this.buttons.all.textContent = measured ? `Accept ${counted(measured, "proposal")}` : "Accept all"
  }

  refreshRun() {
    const { run } = this.model.state
    const running = run?.state === "running"
    const parts = []
    if (running) parts.push(make("progress", { "aria-label": "automatic run" }))
    if (run) parts.push(make("span", { className: run.state === "failed" ? "m-bad" : "" }, running ? `${run.stage ?? ""}: ${run.sentence ?? ""}`.replace(/^: |: $/g, "") : (run.sentence ?? "")))
    if (run?.report) parts.push(make("a", { href: "report/report.html", target: "_blank", rel: "noopener", title: run.report }, "Open the report"))
    parts.push(button("Find the rest automatically", () => this.automatic(), { disabled: running, title: "targets and texture in all photographs, adjusted with the marks (A)" }))
    this.run.replaceChildren(...parts)
  }

  say(words, wrong = false) {
    this.told.textContent = words
    this.told.className = wrong ? "m-bad" : ""
  }

  // ---- tools

  makeTools() {
    const act = (words, key, action, properties = {}) => button(words, action, { title: key, ...properties })
    this.buttons = {
      undo: act("Undo", "Z", () => this.undo()),
      redo: act("Redo", "Shift+Z", () => this.redo()),
      fresh: act("New point", "N", () => this.chooseNew()),
      all: act("Accept all", "Shift+Enter", () => this.acceptAll(), { className: "m-all" }),
    }
    this.aim = make("b", {})
    const known = KINDS.filter((kind) => kind !== "ring" || this.model.state.codes)
    const kinds = [["", "what fits (0)"], ...known.map((kind) => [kind, `${kind === "hand" ? "by hand" : kind} (${KINDS.indexOf(kind) + 1})`])]
    this.kinds = choice("measured as", kinds, (kind) => this.setKind(kind || null), { value: "" })
    const sigma = make("input", { type: "number", min: 0.01, step: 0.1, value: this.model.sigma_px, className: "m-number" })
    sigma.addEventListener("change", () => {
      if (Number(sigma.value) > 0) this.model.sigma_px = Number(sigma.value)
      sigma.value = this.model.sigma_px
    })
    this.sigma = make("label", { className: "v-choice", hidden: true }, "sigma ", sigma, " px")
    this.layouts = choice("side by side", LAYOUTS.map((n) => [n, String(n)]), (n) => this.layOut(Number(n)), { title: "photographs side by side (L)" })
    this.sliders = Object.fromEntries(["brightness", "contrast"].map((name) => [name, this.slider(name)]))
    this.ticks = {
      names: tick("names", true, () => this.toggle("names")),
      residuals: tick("residuals", true, () => this.toggle("residuals")),
    }
    this.tools.append(
      make("span", { className: "m-aim" }, "point ", this.aim),
      this.buttons.fresh,
      this.kinds,
      this.sigma,
      this.buttons.all,
      this.buttons.undo,
      this.buttons.redo,
      this.layouts,
      ...Object.entries(this.sliders).map(([name, slider]) => make("label", { className: "v-choice" }, `${name} `, slider)),
      this.ticks.names,
      this.ticks.residuals,
      act("Keys ?", "what every key does", () => this.help()),
    )
  }

  slider(name) {
    const limit = Math.log(LIGHT_LIMIT)
    const slider = make("input", { type: "range", min: -limit, max: limit, step: 0.01, value: 0 })
    slider.addEventListener("input", () => this.setLight(name, Math.exp(Number(slider.value))))
    return slider
  }

  light(name, sign) {
    if (name === null) for (const each of Object.keys(this.lights)) this.setLight(each, 1)
    else this.setLight(name, this.lights[name] * LIGHT_STEP ** sign)
  }

  setLight(name, value) {
    this.lights[name] = Math.min(LIGHT_LIMIT, Math.max(1 / LIGHT_LIMIT, value))
    this.sliders[name].value = Math.log(this.lights[name])
    this.grid.style.setProperty(`--${name}`, this.lights[name])
    this.grid.classList.toggle("m-lit", Object.values(this.lights).some((light) => light !== 1)) // a filter takes time
    this.say(`${name} ${significant(this.lights[name], 2)}`)
  }

  toggle(what) {
    this.shown[what] = !this.shown[what]
    this.ticks[what].querySelector("input").checked = this.shown[what]
    this.refresh()
  }

  setKind(kind) {
    if (kind === "ring" && !this.model.state.codes) {
      this.kinds.querySelector("select").value = this.model.kind ?? ""
      return this.say("The survey names no family of codes: mark rings as target, and name their points.", true)
    }
    this.model.kind = kind
    this.kinds.querySelector("select").value = kind ?? ""
    this.sigma.hidden = kind !== "hand"
    this.say(kind === null ? "Clicks are measured as what fits." : kind === "hand" ? "Clicks are taken as they are, with the sigma stated." : `Clicks are measured as ${kind}.`)
  }

  help() {
    showHelp(this.keys)
  }

  // ---- photographs in panes

  layOut(count) {
    const shown = this.panes.map((pane) => pane.image)
    for (const pane of this.panes) pane.close()
    const { photographs } = this.model.state
    const free = photographs.map(({ index }) => index).filter((image) => !shown.includes(image))
    const after = free.filter((image) => image > (shown.at(-1) ?? -1))
    const images = [...shown, ...after, ...free.filter((image) => !after.includes(image))].slice(0, count)
    const actions = {
      click: (pane, place, again) => this.click(pane, place, again),
      choose: (pane, name) => this.chooseAt(pane, name),
      hover: (pane, place) => this.hover(pane, place),
      activate: (pane) => this.activate(pane.number),
      show: (pane, image) => this.showIn(pane, image),
      words: (pane) => this.model.pointFor(pane.image) ?? "new point",
    }
    this.panes = images.map((_, number) => new Pane(this.model, number, count, actions))
    this.grid.dataset.count = count
    this.grid.replaceChildren(...this.panes.map((pane) => pane.element))
    this.layouts.querySelector("select").value = count
    this.active = Math.min(this.active, this.panes.length - 1)
    this.panes.forEach((pane, number) => pane.show(images[number]))
    this.activate(this.active)
    this.refresh()
  }

  nextLayout() {
    const now = LAYOUTS.indexOf(Number(this.grid.dataset.count))
    const had = this.grid.contains(document.activeElement)
    this.layOut(LAYOUTS[(now + 1) % LAYOUTS.length])
    if (had) this.pane.view.focus()
  }

  activate(number) {
    this.active = number
    this.panes.forEach((pane, k) => pane.element.classList.toggle("m-active", k === number && this.panes.length > 1))
    if (this.buttons) this.strip.refresh(this.panes.map((pane) => pane.image), this.pane.image)
  }

  /** Show a photograph in a pane. One that another pane shows changes places, or stays there if a place in it is asked for. */
  showIn(pane, image, place = null) {
    const there = this.panes.find((other) => other.image === image) ?? null
    const target = place && there ? there : pane
    if (there && there !== target) there.show(pane.image)
    target.show(image, place)
    this.activate(target.number)
    this.strip.reveal(image)
  }

  stepPhotograph(step) {
    const count = this.model.state.photographs.length
    this.showIn(this.pane, (this.pane.image + step + count) % count)
  }

  /** Show the photographs that follow those in the panes, or come before them. */
  stepAll(step) {
    const count = this.model.state.photographs.length
    const from = step > 0 ? Math.max(...this.panes.map((pane) => pane.image)) + 1 : Math.min(...this.panes.map((pane) => pane.image)) - this.panes.length
    const first = step > 0 && from >= count ? 0 : Math.max(0, Math.min(from, count - this.panes.length))
    this.panes.forEach((pane, k) => pane.show((first + k) % count))
    this.refresh()
    this.strip.reveal(this.pane.image)
  }

  /** Show the chosen point large in every pane whose photograph has it. */
  go() {
    const { model } = this
    if (!this.hasChosen()) return
    for (const pane of this.panes) {
      const there = model.markOf(pane.image, model.chosen) ?? model.proposalOf(pane.image, model.chosen)
      if (there) pane.centre([there.x, there.y])
    }
  }

  /** Put photographs with proposals of the chosen point into the panes that do not have it. */
  openWaiting() {
    const { model } = this
    if (!this.hasChosen()) return
    const waiting = (model.proposed.get(model.chosen) ?? []).map((proposal) => proposal.image).filter((image) => !this.panes.some((pane) => pane.image === image))
    for (const pane of this.panes) {
      const own = model.proposalOf(pane.image, model.chosen)
      if (!own && waiting.length && pane !== this.pane) pane.show(waiting.shift())
    }
    this.refresh()
    this.go()
  }

  openWorst() {
    const { worst } = this.model.state.adjustment
    if (!worst) return this.say("No mark stands out: nothing is adjusted yet.")
    const mark = this.model.markOf(worst.image, worst.point)
    this.model.choose(worst.point)
    this.showIn(this.pane, worst.image, [mark.x, mark.y])
  }

  fit() {
    this.pane.fit()
  }

  turn() {
    this.pane.turn()
  }

  hover(pane, place) {
    const before = this.model.told
    this.model.hovered = place ? pane.image : null
    if (this.model.told !== before) for (const other of this.panes) if (other !== pane) other.draw()
    this.askSight(pane, place)
  }

  /** Ask where the ray of sight of a place is in the other photographs: one request at a time, the last place counts. */
  async askSight(pane, place) {
    this.looked = place && this.model.photograph(pane.image).oriented ? { image: pane.image, place } : null
    if (!this.looked) this.showSight([])
    if (this.looking) return
    this.looking = true
    while (this.looked) {
      const { image, place: [x, y] } = this.looked
      const asked = this.looked
      const told = await this.server.look(`sight?${new URLSearchParams({ image, x, y })}`)
      if (this.looked) this.showSight(told?.lines ?? [])
      await new Promise((resolve) => setTimeout(resolve, SIGHT_MS))
      if (this.looked === asked) break
    }
    this.looking = false
  }

  showSight(lines) {
    for (const pane of this.panes) {
      const sight = lines.filter((line) => line.image === pane.image).map((line) => line.xy)
      const changed = sight.length || pane.sight.length
      pane.sight = sight
      if (changed) pane.draw()
    }
  }

  // ---- changes

  async click(pane, place, again) {
    const { model } = this
    const { image } = pane
    pane.pending.push(place)
    pane.draw()
    const { aim, kind, sigma_px } = model // of this click, whatever the person does until it is measured
    const body = () => ({ image, x: place[0], y: place[1], point: again ? aim.point : model.pointFor(image, aim.point), kind, sigma_px: kind === "hand" ? sigma_px : null })
    await this.change("click", body, ({ mark, note }) => {
      model.hit(aim, mark.point)
      const sigma = significant(Math.max(...mark.sigma), 2)
      return `${mark.point} in ${model.photograph(image).name}: ${mark.kind}${mark.by === "hand" ? " by hand" : ""}, sigma ${sigma} px.${note ? ` ${note}` : ""}`
    })
    pane.pending.splice(pane.pending.indexOf(place), 1)
    this.refresh()
  }

  /** Measure the chosen mark in the active photograph again. */
  again() {
    const { model } = this
    if (!this.hasChosen()) return
    const mark = model.markOf(this.pane.image, model.chosen)
    if (mark) this.click(this.pane, [mark.x, mark.y], true)
    else this.say(`${model.chosen} is not marked in this photograph.`, true)
  }

  /** Send a change, and say what became of it: words, or what `words` makes of the answer. */
  async change(what, body, words) {
    try {
      await this.server.change(what, body, (answer) => this.say(typeof words === "function" ? words(answer) : words))
    } catch (error) {
      this.say(error.message, true)
    }
  }

  hasChosen() {
    if (this.model.chosen === null) this.say("Choose a point first: in the list, or its mark in a photograph.", true)
    return this.model.chosen !== null
  }

  chooseAt(pane, point) {
    this.model.choose(point)
    this.say(this.model.markOf(pane.image, point) ? `${point} is chosen.` : `${point} is proposed here: Enter accepts all its proposals, Y this one, X refuses it.`)
  }

  chooseNew() {
    this.model.choose(null)
    this.say("The next click measures a new point.")
  }

  accept() {
    const point = this.model.chosen
    if (!this.hasChosen()) return
    const measured = this.model.measured(this.model.proposed.get(point) ?? [])
    if (measured.length) this.change("accept", { point, version: this.server.version }, ({ count }) => `${counted(count, "proposal")} of ${point} accepted.`)
    else this.say(`Nothing measured is proposed for ${point}.`, true)
  }

  acceptHere() {
    const point = this.model.chosen
    const { image } = this.pane
    if (!this.hasChosen()) return
    if (this.model.proposalOf(image, point)?.measured) this.change("accept", { image, point, version: this.server.version }, `Proposal of ${point} accepted here.`)
    else this.say(`Nothing measured is proposed for ${point} in this photograph: click it.`, true)
  }

  acceptAll() {
    const measured = this.model.measured(this.model.state.proposals)
    if (measured.length) this.change("accept", { version: this.server.version }, ({ count }) => `${counted(count, "proposal")} accepted.`)
    else this.say("Nothing measured is proposed.", true)
  }

  refuse() {
    const point = this.model.chosen
    if (!this.hasChosen()) return
    const proposals = this.model.proposed.get(point) ?? []
    if (proposals.length) this.change("refuse", { point, version: this.server.version }, ({ count }) => `${counted(count, "proposal")} of ${point} refused.`)
    else this.say(`${point} has no proposals.`, true)
  }

  refuseHere() {
    const point = this.model.chosen
    const { image } = this.pane
    if (!this.hasChosen()) return
    if (this.model.markOf(image, point)?.automatic) this.removeHere()
    else if (this.model.proposalOf(image, point)) this.change("refuse", { image, point, version: this.server.version }, `Proposal of ${point} refused here.`)
    else this.say(`${point} has no proposal in this photograph.`, true)
  }

  removeHere() {
    const point = this.model.chosen
    const { image } = this.pane
    if (!this.hasChosen()) return
    const mark = this.model.markOf(image, point)
    if (mark?.automatic) this.change("refuse", { image, point, version: this.server.version }, `Mark of ${point} refused here; Z undoes it.`)
    else if (mark) this.change("delete", { image, point }, `Mark of ${point} deleted here; Z undoes it.`)
    else this.say(`${point} is not marked in this photograph; Shift+Delete deletes the whole point.`, true)
  }

  remove() {
    const point = this.model.chosen
    if (this.hasChosen()) this.change("delete", { point }, `${point} deleted; Z undoes it.`)
  }

  undo() {
    this.stepBack("undo", "Undone", "Nothing to undo.")
  }

  redo() {
    this.stepBack("redo", "Done again", "Nothing to do again.")
  }

  /** Undo or redo what the page shows as the last change; of another page only when asked again. */
  stepBack(what, done, nothing) {
    const step = this.model.state[what]
    const anyway = this.doubted === step?.number
    this.doubted = null
    if (!step) this.say(nothing, true)
    else if (!this.server.made(step) && !anyway) {
      this.doubted = step.number
      this.say(`Another page made the last change: ${step.what}. The same key again changes it all the same.`, true)
    } else {
      // keys that follow fast mean one change each: whatever is the last one of this page in its turn
      let change = step
      const body = () => {
        if (!anyway) change = this.model.state[what] ?? step
        return { number: change.number, anyway }
      }
      this.change(what, body, () => `${done}: ${change.what}.`)
    }
  }

  automatic() {
    if (this.model.state.run?.state !== "running") this.change("automatic", {}, "Searching in all photographs.")
  }

  step(by) {
    const names = this.model.names
    if (!names.length) return
    const from = names.indexOf(this.model.chosen)
    const to = from < 0 ? (by > 0 ? 0 : names.length - 1) : (from + by + names.length) % names.length
    this.model.choose(names[to])
  }

  reset() {
    this.setKind(null)
    this.chooseNew()
  }

  // ---- forms

  rename() {
    const point = this.model.chosen
    if (!this.hasChosen()) return
    ask(`Rename ${point}`, [{ key: "name", words: "name", value: point }], async ({ name }) => {
      await this.server.change("rename", { point, name })
      this.model.choose(name)
      this.say(`${point} is ${name} now.`)
    })
  }

  control() {
    const point = this.model.chosen
    if (!this.hasChosen()) return
    const given = this.model.pointOf.get(point)?.control
    const { unit } = this.model.state
    const field = (key, words, value) => ({ key, words: `${words} [${unit}]`, value, number: true })
    const fields = ["X", "Y", "Z"].flatMap((axis, c) => [field(axis, axis, given?.X[c]), field(`s${axis}`, `sigma ${axis}`, given?.sigma[c])])
    const send = async ({ X, Y, Z, sX, sY, sZ }) => {
      await this.server.change("control", { point, X, Y, Z, sigma: [sX, sY, sZ] })
      this.say(`${point} is a control point.`)
    }
    const drop = async () => {
      await this.server.change("control", { point, remove: true })
      const { control: left } = this.model.pointOf.get(point) ?? {}
      this.say(left ? `${point} has the coordinates of the survey again.` : `${point} is no control point now.`)
    }
    ask(`Coordinates of ${point} as control`, fields, send, { also: given && !given.given ? [["No control", drop]] : [] })
  }

  bar() {
    const names = this.model.names
    const { unit } = this.model.state
    const fields = [
      { key: "start", words: "from point", value: this.model.chosen ?? "", list: names },
      { key: "end", words: "to point", list: names },
      { key: "length", words: `length [${unit}]`, number: true },
      { key: "sigma", words: `sigma [${unit}]`, number: true },
    ]
    ask("Scale bar", fields, async (bar) => {
      await this.server.change("bar", bar)
      this.say(`Bar ${bar.start} \u2013 ${bar.end} added.`)
    })
  }
}

const root = document.getElementById("marking")
const page = new Page(root)
root.page = page // for tests
page.server.follow()
