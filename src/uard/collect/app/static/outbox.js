// What was answered and is not acknowledged yet. It is kept in the browser's storage, so that neither a cut, a reload
// nor a restart of the server loses it, and sent again until the server says that it has it. Every record has an id of
// its own, so that the server stores it once. What the server will never take is set aside, and stays until the rater
// herself drops it: nothing that she said disappears unseen.

const PATIENCE = 10000; // milliseconds until a request counts as lost
const WAITS = [500, 1000, 2000, 4000, 8000];

export class Outbox {
  // `told(record, reply)`: it is stored; `refused(record, sentence)`: it was set aside; `stopped(sentence, why)`: nothing
  // more is sent from this page, and all is kept; `changed()`: look at `records()` and `aside()`.
  constructor(key, page, { told, refused, stopped, changed }) {
    this.key = key;
    this.page = page;
    this.told = told;
    this.refused = refused;
    this.stopped = stopped;
    this.changed = changed;
    this.failures = 0;
    this.memory = { "": [], ":aside": [] };
    this.kept = this.tryStorage();
    window.addEventListener("online", () => this.now());
    window.addEventListener("storage", (event) => { if (event.key?.startsWith(this.key)) this.changed(); });
    window.addEventListener("beforeunload", (event) => {
      if (this.records().length + this.aside().length && !this.kept) event.preventDefault();
    });
  }

  tryStorage() {
    try {
      localStorage.setItem(`${this.key}?`, "1");
      localStorage.removeItem(`${this.key}?`);
      return true;
    } catch {
      return false;
    }
  }

  records() {
    return this.read("");
  }

  // What was refused, with the sentence that says why.
  aside() {
    return this.read(":aside");
  }

  read(which) {
    if (!this.kept) return this.memory[which];
    try {
      const found = JSON.parse(localStorage.getItem(this.key + which) ?? "[]");
      return Array.isArray(found) ? found : [];
    } catch {
      return [];
    }
  }

  write(records, which = "") {
    if (this.kept) {
      try {
        localStorage.setItem(this.key + which, JSON.stringify(records));
        return;
      } catch {
        this.memory = { "": this.records(), ":aside": this.aside() };
        this.kept = false; // full, or taken away meanwhile
      }
    }
    this.memory[which] = records;
  }

  add(path, body) {
    this.write([...this.records(), { path, body: { ...this.page, ...body }, at: Date.now() }]);
    this.now();
  }

  setAside(record, sentence) {
    this.write([...this.aside(), { ...record, sentence }], ":aside"); // before it is taken out: it is never nowhere
    this.remove(record.body.id);
  }

  drop(id) {
    this.write(this.aside().filter((r) => r.body.id !== id), ":aside");
    this.changed();
  }

  retry(id) {
    const again = this.aside().filter((r) => r.body.id === id);
    this.write([...this.records(), ...again]);
    this.drop(id);
    this.now();
  }

  // Takes a record out that was not sent yet; false if it may have been.
  withdraw(id) {
    if (this.sending === id) return false;
    if (this.aside().some((r) => r.body.id === id)) {
      this.drop(id);
      return true;
    }
    const records = this.records();
    const left = records.filter((r) => r.body.id !== id);
    if (left.length === records.length || this.tried?.has(id)) return false;
    this.write(left);
    this.changed();
    return true;
  }

  remove(id) {
    this.write(this.records().filter((r) => r.body.id !== id));
  }

  now() {
    clearTimeout(this.timer);
    this.timer = undefined;
    this.run();
  }

  // Sends one after the other, in the order in which they were given.
  async run() {
    if (this.running || this.locked) return;
    this.running = true;
    try {
      for (let record = this.records()[0]; record; record = this.records()[0]) {
        this.changed();
        if (!(await this.send(record))) return;
        this.failures = 0;
      }
    } finally {
      this.running = false;
      this.changed();
    }
  }

  stop(sentence, why) {
    this.locked = true;
    this.stopped(sentence, why);
  }

  async send(record) {
    const { id } = record.body;
    (this.tried ??= new Set()).add(id);
    this.sending = id;
    let response;
    let reply;
    try {
      response = await post(record.path, record.body, true);
      reply = await response.json();
    } catch {
      response = undefined;
    }
    this.sending = undefined;
    if (response?.ok) {
      this.remove(id);
      this.told(record, reply);
      return true;
    }
    const { status } = response ?? {};
    // Another rater's browser now, or a question that is not asked any more by this very page: all is kept as it is.
    if (status === 401 || reply?.why === "rater" || (reply?.why === "question" && record.body.question === this.page.question)) {
      this.stop(reply?.error ?? "", reply?.why);
      return false;
    }
    if ([400, 403, 404, 409, 413].includes(status) && reply?.error) {
      // What is to be taken back and does not count, or was taken back already, needs nothing more.
      if (record.path === "/api/undo" && [404, 409].includes(status)) this.remove(id);
      else this.setAside(record, reply.error);
      this.refused(record, reply.error);
      return true;
    }
    const wait = Math.max(WAITS[Math.min(this.failures, WAITS.length - 1)], status === 429 ? 1000 : 0);
    this.failures += 1;
    this.why = response ? reply?.error : undefined;
    this.timer = setTimeout(() => this.now(), wait);
    return false;
  }
}

export function post(path, body, keepalive = false) {
  return fetch(path, {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify(body),
    keepalive,
    signal: AbortSignal.timeout(PATIENCE),
  });
}

// A name that no other answer has; also where a page is no secure context and has no crypto.randomUUID.
export function newId() {
  return Array.from(crypto.getRandomValues(new Uint8Array(16)), (x) => x.toString(16).padStart(2, "0")).join("");
}
