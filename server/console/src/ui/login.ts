/** Who are you: asked when the server wants a token, or the one that it got is not good any more. */

import type { Api } from "../api.ts";
import { h } from "../dom.ts";

/** Ask until a token is good for reading maps; resolves then. */
export function logIn(api: Api, why: string): Promise<void> {
  return new Promise((resolve) => {
    const token = h("input", {
      type: "password", id: "token", autocomplete: "current-password", required: true, spellcheck: "false",
    });
    const stays = h("input", { type: "checkbox", id: "stays" });
    const said = h("p", { class: "error", role: "alert" }, why);
    const form = h(
      "form", { method: "dialog" },
      h("h1", {}, "cairn"),
      h("p", {}, "This map server wants to know who you are."),
      said,
      h("label", { for: "token" }, "Token"), token,
      h("label", { class: "check" }, stays, " Stay logged in on this computer"),
      h("button", { type: "submit", class: "main" }, "Log in"),
      h("p", { class: "hint" }, "An administrator makes one: ", h("code", {}, "cairn token create URL NAME --role reader")),
    );
    const dialog = h("dialog", { class: "login", "aria-label": "Log in" }, form);
    dialog.addEventListener("cancel", (event) => event.preventDefault());
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      api.logIn(token.value.trim(), stays.checked);
      api.json("maps").then(
        () => {
          dialog.close();
          dialog.remove();
          resolve();
        },
        (error: Error) => {
          api.logOut();
          said.textContent = error.message;
          token.select();
        },
      );
    });
    document.body.append(dialog);
    dialog.showModal();
    token.focus();
  });
}
