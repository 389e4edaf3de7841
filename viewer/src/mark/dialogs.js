// Forms of the page: they open over it, Escape closes them.

import { button, make } from "../page.js"

/**
 * Ask for values, and send them.
 * @param fields of {key, words, value, number, list}: a field of text, or of a number.
 * @param send gets the values by key; what it throws is shown, and the form stays.
 */
export function ask(title, fields, send, { confirm = "OK", also = [] } = {}) {
  const inputs = fields.map(({ key, words, value = "", number = false, list = [] }) => {
    const input = make("input", { name: key, value: String(value), required: true, autocomplete: "off" })
    if (number) input.setAttribute("inputmode", "decimal")
    const names = list.length ? make("datalist", { id: `m-list-${key}` }, ...list.map((name) => make("option", { value: name }))) : null
    if (names) input.setAttribute("list", names.id)
    return { key, number, input, label: make("label", {}, make("span", {}, words), input, names) }
  })
  const wrong = make("p", { className: "m-bad", role: "alert" })
  const form = make(
    "form",
    { method: "dialog" },
    make("h2", {}, title),
    make("div", { className: "m-fields" }, ...inputs.map(({ label }) => label)),
    wrong,
    make("div", { className: "v-tools" }, make("button", { type: "submit", className: "m-main" }, confirm), ...also.map(([words, act]) => button(words, () => done(act()))), button("Cancel", () => close())),
  )
  const close = show(form, title)
  const done = (sent) => sent.then(close, (error) => (wrong.textContent = error.message))
  form.addEventListener("submit", (event) => {
    event.preventDefault()
    const values = {}
    for (const { key, number, input } of inputs) {
      values[key] = number ? Number(input.value.replace(",", ".")) : input.value.trim()
      const sound = number ? input.value.trim() !== "" && Number.isFinite(values[key]) : values[key] !== ""
      input.classList.toggle("v-wrong", !sound)
      if (!sound) {
        wrong.textContent = number ? `${input.value || "Nothing"} is not a number.` : "A name is needed."
        input.focus()
        return
      }
    }
    done(send(values))
  })
  inputs[0].input.select()
}

/** Open a dialog with content; returns what closes it. */
export function show(content, title) {
  const dialog = make("dialog", { className: "v-app", "aria-label": title }, content)
  dialog.addEventListener("close", () => dialog.remove())
  document.body.append(dialog)
  dialog.showModal()
  return () => dialog.close()
}
