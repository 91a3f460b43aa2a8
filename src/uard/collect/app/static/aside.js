// What the server did not take: the rater may send it again, when the question is what it was, say, or drop it.

import { shortened } from "./rows.js";

function told({ values, choice }) {
  const rated = Object.entries(values ?? {}).map(([name, value]) => `${name ? `${name} ` : ""}${shortened(value)}`);
  return choice ?? rated.join(", ");
}

export class Aside {
  // `open()`: shows the dialog.
  constructor(outbox, open) {
    this.outbox = outbox;
    this.open = open;
    this.opener = document.getElementById("show-aside");
    this.dialog = document.getElementById("aside");
    this.list = document.getElementById("aside-list");
    this.opener.addEventListener("click", () => this.show());
    this.dialog.addEventListener("close", () => this.opener.blur()); // Enter is to submit, not to open it again
  }

  // Says how many there are.
  tell() {
    const number = this.outbox.aside().length;
    this.opener.hidden = !number;
    this.opener.textContent = `${number} not accepted`;
  }

  show() {
    const kept = this.outbox.aside();
    this.list.replaceChildren(...kept.map((record) => this.row(record)));
    if (kept.length) this.open();
    else this.dialog.close();
  }

  row({ body, at, sentence }) {
    const row = document.createElement("li");
    const text = document.createElement("p");
    text.textContent = `${at ? `${new Date(at).toLocaleString()}: ` : ""}${told(body)}. ${sentence}`;
    row.append(text, this.button("Send again", () => this.outbox.retry(body.id)), " ", this.button("Drop", () => this.outbox.drop(body.id)));
    return row;
  }

  button(text, does) {
    const made = document.createElement("button");
    made.type = "button";
    made.textContent = text;
    made.addEventListener("click", () => { does(); this.show(); });
    return made;
  }
}
