// Requests to the program, which runs on this computer, and the state that it keeps. Addresses are relative to the page's.

const SECRET = location.pathname.split("/")[1] // the first part of the address of the page
const PATIENCE_MS = 40_000 // for an answer; the program holds a request for a newer state for 25 s
const REST_MS = 1000 // after an answer without news, which more pages than may wait are given at once
const HIDDEN = Symbol("hidden") // why a page that nobody sees ends its waiting request
const PAUSES_MS = [500, 1000, 2000, 5000] // before the next request, while the program does not answer

/** The program has refused a change; the message is its sentence. */
export class Refusal extends Error {}

/** Another program answers at this address, or this one with another secret. */
class Stranger extends Error {}

export class Server {
  #last = Promise.resolve() // the change sent last: changes reach the program in the order of the clicks
  #poll = null // ends the request that waits for a newer state
  #waiting = [] // told as soon as the program answers again

  /** @param hub hears `state` with each newer state, `lost` with a sentence and `back`. */
  constructor(hub) {
    this.hub = hub
    this.version = null
    this.page = crypto.randomUUID() // tells the changes of this page from those of others
    this.failures = 0
    this.open = 0 // changes that are not answered yet
  }

  get idle() {
    return this.open === 0
  }

  /** Whether a change was made by this page, or by none, as by --import. */
  made(change) {
    return ["", this.page].includes(change.page)
  }

  /**
   * Keep the state current: each request waits in the program until there is a newer one.
   * A page that nobody sees does not wait: a browser has few connections to one program, and clicks need them.
   */
  async follow() {
    document.addEventListener("visibilitychange", () => document.hidden && this.#poll?.abort(HIDDEN))
    for (;;) {
      while (document.hidden && this.version !== null) await new Promise((resolve) => document.addEventListener("visibilitychange", resolve, { once: true }))
      try {
        const fresh = this.version === null || this.failures > 0
        this.#poll = new AbortController()
        const state = await this.#ask(fresh ? "state" : `state?after=${this.version}`, { signal: AbortSignal.any([this.#poll.signal, AbortSignal.timeout(PATIENCE_MS)]) })
        const isNew = fresh || state.version > this.version
        this.#take(state, fresh)
        this.#answered()
        if (!isNew) await new Promise((resolve) => setTimeout(resolve, REST_MS))
      } catch (error) {
        if (error !== HIDDEN) await this.#lose(error)
      }
    }
  }

  /**
   * Send a change and return the answer of the program.
   * While the program does not answer, the change waits; it is sent again only if nothing was changed in between.
   * @param body the content, or a function that returns it when it is this change's turn.
   * @param follow gets the answer before the next change has its turn.
   */
  change(what, body, follow = () => {}) {
    const sent = this.#last.then(async () => {
      const answer = await this.#send(what, typeof body === "function" ? body() : body)
      follow(answer)
      return answer
    })
    this.open += 1
    this.#last = sent.catch(() => {}).finally(() => (this.open -= 1))
    return sent
  }

  async #send(what, body) {
    const before = this.version
    const options = { method: "POST", headers: { "Content-Type": "application/json", "X-Kolinear": SECRET }, body: JSON.stringify({ ...body, page: this.page }) }
    for (;;) {
      let answer
      try {
        answer = await this.#ask(what, options)
      } catch (error) {
        if (error instanceof Refusal) throw error
        const back = new Promise((resolve) => this.#waiting.push(resolve))
        this.#poll?.abort() // ask at once whether the program still answers
        await back
        if (this.version !== before) throw new Refusal("The program did not answer in time. Look whether the last change was made; if not, make it again.")
        continue
      }
      this.#take(answer.state?.photographs ? answer.state : answer, false)
      return answer
    }
  }

  /** Ask without a change; null if the program does not answer. */
  async look(address) {
    try {
      return await this.#ask(address)
    } catch {
      return null
    }
  }

  async #ask(address, options = {}) {
    const answer = await fetch(address, { cache: "no-store", signal: AbortSignal.timeout(PATIENCE_MS), ...options })
    if (answer.status === 403 || answer.status === 404) throw new Stranger()
    const told = await answer.json()
    if (answer.ok) return told
    throw new Refusal(told.error ?? `The program answered ${answer.status}.`)
  }

  #take(state, fresh) {
    if (!state.photographs || (!fresh && this.version !== null && state.version <= this.version)) return
    this.version = state.version
    this.hub.tell("state", state)
  }

  #answered() {
    if (this.failures) this.hub.tell("back", null)
    this.failures = 0
    for (const resolve of this.#waiting.splice(0)) resolve()
  }

  #lose(error) {
    this.hub.tell("lost", lostWords(error))
    const pause = PAUSES_MS[Math.min(this.failures, PAUSES_MS.length - 1)]
    this.failures += 1
    return new Promise((resolve) => setTimeout(resolve, pause))
  }
}

function lostWords(error) {
  if (error instanceof Stranger) return "Another program answers at this address. Close this page and open the address that kolinear mark printed last."
  return "The program does not answer. Every mark up to the last click is saved; this page tries again. If the program has ended, start kolinear mark again."
}
