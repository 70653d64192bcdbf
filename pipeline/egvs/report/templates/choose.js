// Draws the views of the site that a reader chooses: joins each image's data to the palette of the page's colours.
(() => {
  const data = JSON.parse(document.getElementById("site-data").textContent);
  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const address = (image, palette) => {
    const [head, pixels] = image;
    return URL.createObjectURL(new Blob([head, palette, pixels, data.end].map(bytes), { type: "image/png" }));
  };
  const set = (element, image, palette) => {
    if (element.dataset.made) URL.revokeObjectURL(element.getAttribute("href"));
    element.setAttribute("href", address(image, palette));
    element.dataset.made = 1;
  };
  const tell = (view, its) => {
    view.querySelector(".share-vehicles").textContent = its.missed;
    view.querySelector(".worst-note").textContent = its.note;
    view.querySelector(".worst-places").replaceChildren(...its.worst.map(([words, rests]) => {
      const item = document.createElement("li"), small = document.createElement("small");
      small.textContent = rests;
      item.append(words, small);
      return item;
    }));
    view.querySelectorAll("g.worst").forEach((mark, number) => {
      const at = its.numbers[number];
      if (at) mark.setAttribute("transform", `translate(${at.join(" ")})`);
      mark.setAttribute("display", at ? "inline" : "none");
    });
  };
  const choose = (panel, name) => {
    const site = data.sites[name];
    panel.querySelector("select").value = name;
    panel.querySelector(".chosen").textContent = name;
    panel.querySelector(".share-seen").textContent = site.share[0];
    panel.querySelector(".share-missed").textContent = site.share[1];
    panel.querySelector("figcaption").textContent = site.caption;
    if (site.vehicles) tell(panel.querySelector("[data-view=vehicles]"), site.vehicles);
    for (const kind of Object.keys(site.images).filter(kind => kind !== "shade")) {
      const svg = panel.querySelector(`[data-view=${kind}] svg`);
      svg.setAttribute("aria-label", `From above, ${kind}: ${site.caption}`);
      svg.querySelector(".sensor").setAttribute("transform", `translate(${site.at.join(" ")})`);
      for (const look of ["day", "night"]) {
        const palette = data.palettes[look][kind in data.palettes[look] ? kind : "field"];
        set(svg.querySelector(`.field.${look}`), site.images[kind], palette);
      }
      const shade = svg.querySelector(".shade");
      if (shade) set(shade, site.images.shade, data.palettes.shade);
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
