// What was answered and is not acknowledged yet. It is kept in the browser's storage, so that neither a cut, a reload
// nor a restart of the server loses it, and sent again until the server says that it has it. Every record has an id of
// its own, so that the server stores it once.

const PATIENCE = 10000; // milliseconds until a request counts as lost
const WAITS = [500, 1000, 2000, 4000, 8000];

export class Outbox {
  // `told(record, reply)`: it is stored; `refused(record, sentence, status)`: it never will be; `changed()`: look at `state`.
  constructor(key, { told, refused, changed }) {
    this.key = key;
    this.told = told;
    this.refused = refused;
    this.changed = changed;
    this.failures = 0;
    this.memory = [];
    this.kept = this.tryStorage();
    window.addEventListener("online", () => this.now());
    window.addEventListener("storage", (event) => { if (event.key === this.key) this.changed(); });
    window.addEventListener("beforeunload", (event) => {
      if (this.records().length && !this.kept) event.preventDefault();
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
    if (!this.kept) return this.memory;
    try {
      const found = JSON.parse(localStorage.getItem(this.key) ?? "[]");
      return Array.isArray(found) ? found : [];
    } catch {
      return [];
    }
  }

  write(records) {
    if (this.kept) {
      try {
        localStorage.setItem(this.key, JSON.stringify(records));
        return;
      } catch {
        this.kept = false; // full, or taken away meanwhile
      }
    }
    this.memory = records;
  }

  add(path, body) {
    this.write([...this.records(), { path, body }]);
    this.now();
  }

  // Takes a record out that was not sent yet; false if it may have been.
  withdraw(id) {
    if (this.sending === id) return false;
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
    if (response?.status === 401) {
      this.locked = true;
      this.refused(record, reply.error, 401);
      return false;
    }
    const never = response && [400, 403, 404, 409, 413].includes(response.status);
    if (never && reply?.error) {
      this.remove(id);
      this.refused(record, reply.error, response.status);
      return true;
    }
    const wait = Math.max(WAITS[Math.min(this.failures, WAITS.length - 1)], response?.status === 429 ? 1000 : 0);
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
