// Draws the views of the site that a reader chooses: joins the data of each image with the palettes of the page.
(() => {
  const data = JSON.parse(document.getElementById("site-data").textContent);
  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const imageUrl = (image, palette) => {
    const [head, pixels] = image;
    return URL.createObjectURL(new Blob([head, palette, pixels, data.end].map(bytes), { type: "image/png" }));
  };
  const set = (element, image, palette) => {
    if (element.dataset.made) URL.revokeObjectURL(element.getAttribute("href"));
    element.setAttribute("href", imageUrl(image, palette));
    element.dataset.made = 1;
  };
  const showVehicles = (view, vehicles) => {
    view.querySelector(".share-vehicles").textContent = vehicles.missed;
    view.querySelector(".worst-note").textContent = vehicles.note;
    view.querySelector(".worst-places").replaceChildren(...vehicles.worst.map(([text, sample]) => {
      const item = document.createElement("li"), small = document.createElement("small");
      small.textContent = sample;
      item.append(text, small);
      return item;
    }));
    view.querySelectorAll("g.worst").forEach((mark, number) => {
      const position = vehicles.numbers[number];
      if (position) mark.setAttribute("transform", `translate(${position.join(" ")})`);
      mark.setAttribute("display", position ? "inline" : "none");
    });
  };
  const choose = (panel, name) => {
    const site = data.sites[name];
    panel.querySelector("select").value = name;
    panel.querySelector(".chosen").textContent = name;
    panel.querySelector(".share-seen").textContent = site.share[0];
    panel.querySelector(".share-missed").textContent = site.share[1];
    panel.querySelector("figcaption").textContent = site.caption;
    if (site.vehicles) showVehicles(panel.querySelector("[data-view=vehicles]"), site.vehicles);
    for (const kind of Object.keys(site.images).filter(kind => kind !== "shade")) {
      const svg = panel.querySelector(`[data-view=${kind}] svg`);
      svg.setAttribute("aria-label", `From above, ${kind}: ${site.caption}`);
      svg.querySelector(".sensor").setAttribute("transform", `translate(${site.at.join(" ")})`);
      for (const theme of ["day", "night"]) {
        const palette = data.palettes[theme][kind in data.palettes[theme] ? kind : "field"];
        set(svg.querySelector(`.field.${theme}`), site.images[kind], palette);
      }
      for (const shade of svg.querySelectorAll(".shade")) {
        const theme = shade.classList.contains("day") ? "day" : "night";
        set(shade, site.images.shade, data.palettes[theme].shade);
      }
    }
  };
  const panels = [...document.querySelectorAll("[data-panel]")];
  for (const panel of panels) {
    panel.querySelector("select").addEventListener("change", event => choose(panel, event.target.value));
  }
  for (const link of document.querySelectorAll("[data-site]")) {
    if (!(link.dataset.site in data.sites)) continue;
    link.classList.add("choosable");
    link.addEventListener("click", event => {
      event.preventDefault();
      choose(panels[0], link.dataset.site);
      document.getElementById("views").scrollIntoView({ behavior: "smooth" });
    });
  }
  document.documentElement.classList.add("choosing");
})();
