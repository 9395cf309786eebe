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
    dialog.tabIndex = -1;
    // Pixels of the file, which may be distorted where the shown image is not: of a grid over it, in between bilinear.
    const grid = JSON.parse(document.getElementById("pixels").textContent);
    const told = document.getElementById("pixel"), help = told.textContent;
    const pixel = (event) => {
      const box = dialog.querySelector("img").getBoundingClientRect();
      const u = (event.clientX - box.left) / box.width, v = (event.clientY - box.top) / box.height;
      if (!(u >= 0 && u <= 1 && v >= 0 && v <= 1)) return null;
      const columns = grid.x[0].length, rows = grid.x.length;
      const c = Math.min(Math.floor(u * (columns - 1)), columns - 2), r = Math.min(Math.floor(v * (rows - 1)), rows - 2);
      const s = u * (columns - 1) - c, t = v * (rows - 1) - r;
      const between = (of) => (1 - t) * ((1 - s) * of[r][c] + s * of[r][c + 1]) + t * ((1 - s) * of[r + 1][c] + s * of[r + 1][c + 1]);
      const name = dialog.querySelector("img").alt;
      return `${name},${between(grid.x).toFixed(1)},${between(grid.y).toFixed(1)}`;
    };
    dialog.addEventListener("pointermove", (event) => { told.textContent = pixel(event) || help; });
    dialog.addEventListener("click", (event) => {
      if (event.target.closest("button")) return;
      const at = pixel(event);
      if (at === null) return dialog.close();
      copyText(at).then(() => {
        told.textContent = `copied ${at}`;
        dialog.focus();  // for the arrow keys
      });
    });
    dialog.addEventListener("keydown", (event) => {
      if (event.key === "ArrowRight") show(at + 1);
      if (event.key === "ArrowLeft") show(at - 1);
    });
    dialog.querySelectorAll("[data-step]").forEach((button) => {
      button.addEventListener("click", () => show(at + Number(button.dataset.step)));
    });
  }
}
