// Images open large: a dialog with the picture and its marks; arrow keys go from one to the next.
"use strict";
{
  const dialog = document.getElementById("large");
  const shots = [...document.querySelectorAll(".images .shot")];
  let at = 0;
  const show = (number) => {
    at = (number + shots.length) % shots.length;
    const figure = shots[at].closest("figure");
    dialog.querySelector(".shot").innerHTML = shots[at].innerHTML.replace(/ id="[^"]*"/g, "");
    dialog.querySelector("p").textContent = figure.querySelector("figcaption").innerText.replace(/\n+/g, " · ").replace(" · look from here", "");
  };
  shots.forEach((shot, number) => {
    shot.tabIndex = 0;
    shot.setAttribute("role", "button");
    shot.setAttribute("aria-label", `open image ${number + 1} large`);
    const open = () => { show(number); dialog.showModal(); };
    shot.addEventListener("click", open);
    shot.addEventListener("keydown", (event) => {
      if (event.key === "Enter" || event.key === " ") { event.preventDefault(); open(); }
    });
  });
  if (dialog) {
    dialog.addEventListener("click", (event) => { if (!event.target.closest("button")) dialog.close(); });
    dialog.addEventListener("keydown", (event) => {
      if (event.key === "ArrowRight") show(at + 1);
      if (event.key === "ArrowLeft") show(at - 1);
    });
    dialog.querySelectorAll("[data-step]").forEach((button) => {
      button.addEventListener("click", () => show(at + Number(button.dataset.step)));
    });
  }
}
