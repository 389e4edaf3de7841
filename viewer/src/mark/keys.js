// The keys of the page: one row each, which the page follows and the help lists.

import { button, make } from "../page.js"
import { KINDS } from "./model.js"
import { show } from "./dialogs.js"

const KIND_WORDS = {
  target: "target: its circle or ellipse",
  ring: "ring: a coded target, which tells its name",
  saddle: "saddle: a corner of a chessboard",
  corner: "corner of two edges",
  cross: "cross of two bars",
  window: "window: natural texture",
  hand: "by hand: the place as clicked, with the sigma stated",
}

/** Rows of [key, words, action]: Shift is part of the name of a key, and letters have no case. */
export function keysOf(page) {
  return [
    ["n", "the next click measures a new point", () => page.chooseNew()],
    ["Enter", "accept the proposals of the chosen point", () => page.accept()],
    ["Shift+Enter", "accept all proposals", () => page.acceptAll()],
    ["y", "accept the proposal of the chosen point in the active photograph", () => page.acceptHere()],
    ["x", "refuse the proposal of the chosen point in the active photograph", () => page.refuseHere()],
    ["Shift+x", "refuse all proposals of the chosen point", () => page.refuse()],
    ["Delete", "delete the mark of the chosen point in the active photograph", () => page.removeHere()],
    ["Shift+Delete", "delete the chosen point", () => page.remove()],
    ["m", "measure this mark again, with the kind that is set", () => page.again()],
    ["z", "undo; a change of another page if pressed again", () => page.undo()],
    ["Shift+z", "redo", () => page.redo()],
    ["r", "rename the chosen point", () => page.rename()],
    ["c", "coordinates of the chosen point as control", () => page.control()],
    ["b", "scale bar", () => page.bar()],
    ["k", "next point", () => page.step(1)],
    ["j", "previous point", () => page.step(-1)],
    ["g", "show the chosen point large in all panes", () => page.go()],
    ["o", "open photographs in which the chosen point waits for you", () => page.openWaiting()],
    ["w", "show the mark that fits least", () => page.openWorst()],
    [".", "next photograph in the active pane", () => page.stepPhotograph(1)],
    [",", "previous photograph in the active pane", () => page.stepPhotograph(-1)],
    ["PageDown", "next photographs in all panes", () => page.stepAll(1)],
    ["PageUp", "previous photographs in all panes", () => page.stepAll(-1)],
    ["l", "1, 2, 4 or 6 photographs side by side", () => page.nextLayout()],
    ["f", "show the whole photograph", () => page.fit()],
    ["t", "turn the photograph by 90 degrees", () => page.turn()],
    ["]", "brighter", () => page.light("brightness", 1)],
    ["[", "darker", () => page.light("brightness", -1)],
    ["}", "more contrast", () => page.light("contrast", 1)],
    ["{", "less contrast", () => page.light("contrast", -1)],
    ["\\", "brightness and contrast as they were", () => page.light(null, 0)],
    ["v", "residual vectors", () => page.toggle("residuals")],
    ["h", "names", () => page.toggle("names")],
    ...KINDS.map((kind, k) => [String(k + 1), KIND_WORDS[kind], () => page.setKind(kind)]),
    ["0", "any kind: what fits the click", () => page.setKind(null)],
    ["a", "find everything else automatically", () => page.automatic()],
    ["?", "this help", () => page.help()],
    ["Escape", "no chosen point, any kind", () => page.reset()],
  ]
}

const IN_PHOTOGRAPH = [
  ["click", "measure the chosen point, or a new one if it is marked here already"],
  ["Shift+click", "measure the chosen point again, here"],
  ["click a mark", "choose its point, also where it is proposed"],
  ["drag, wheel", "move the photograph, zoom"],
  ["Tab", "from pane to pane, to the list, to the filmstrip"],
  ["arrow keys", "move the crosshair, with Shift by single steps"],
  ["Space", "measure at the crosshair, with Shift the chosen point again"],
  ["+  \u2212", "zoom"],
]

export function listenToKeys(keys) {
  const actions = new Map(keys.map(([key, , act]) => [key, act]))
  document.addEventListener("keydown", (event) => {
    const { target } = event
    const writes = target.closest("input:not([type=checkbox], [type=range]), select, textarea, dialog")
    if (event.ctrlKey || event.metaKey || event.altKey || writes || event.defaultPrevented) return
    if (event.key === "Enter" && target.closest("button, a, summary")) return
    if (event.key.startsWith("Page") && target.closest(".v-rows")) return
    const name = event.key.length === 1 ? event.key.toLowerCase() : event.key
    const shifted = event.shiftKey && (name.length > 1 || /[a-z]/.test(name)) ? `Shift+${name}` : name
    const act = actions.get(shifted)
    if (!act) return
    event.preventDefault()
    act()
  })
}

export function showHelp(keys) {
  const row = ([key, words]) => make("tr", {}, make("th", { scope: "row" }, make("kbd", {}, key)), make("td", {}, words))
  const table = (rows) => make("table", {}, make("tbody", {}, ...rows.map(row)))
  const content = make(
    "div",
    { className: "m-help" },
    make("h2", {}, "Keys"),
    make("div", { className: "m-columns" }, make("div", {}, make("h3", {}, "In a photograph"), table(IN_PHOTOGRAPH), make("h3", {}, "Everywhere"), table(keys.slice(0, 16))), make("div", {}, table(keys.slice(16)))),
    make("p", { className: "note" }, "Green: accepted marks, by hand as squares. Blue: proposals with their 95 % ellipses, and the epipolar line. Yellow: residual vectors, and the ray of sight of the place under the pointer. Red: the mark that fits least."),
  )
  const close = show(content, "Keys")
  content.append(button("Close", close, { className: "m-main", autofocus: true }))
}
