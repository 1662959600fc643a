// Hovered token and its photo patch.

class Tokens {
    constructor(page) {
        this.page = page;
        this.hovered = -1;
        this.photos = new Map();
        const { canvas } = page;
        canvas.addEventListener("pointermove", event => event.buttons || this.point(event.clientX, event.clientY));
        canvas.addEventListener("click", event => this.point(event.clientX, event.clientY));
        canvas.addEventListener("pointerleave", () => this.leave());
    }

    get group() { return this.page.scene?.group ?? 0; }

    leave() {
        element("source").hidden = true;
        if (this.hovered < 0) return;
        this.hovered = -1;
        this.page.change();
    }

    point(x, y) {
        if (this.page.views.shown !== "tokens") return;
        const waits = this.at;
        this.at = [x, y];
        if (!waits) requestAnimationFrame(() => this.find());
    }

    find() {
        const { page, at } = this;
        this.at = null;
        if (page.views.shown !== "tokens" || !this.group) return;
        const found = page.pick(...at);
        const token = found === null ? -1 : Math.floor(found / this.group);
        if (token === this.hovered) return;
        this.hovered = token;
        this.show(token);
        page.change();
    }

    patch(token) {
        const index = this.page.scene?.patches?.[token], [rows, columns] = config.grid ?? [];
        if (index === undefined || !config.views?.length) return null;
        return { view: Math.floor(index / (rows * columns)), row: Math.floor(index / columns) % rows, column: index % columns };
    }

    async show(token) {
        const patch = token < 0 ? null : this.patch(token);
        element("source").hidden = token < 0;
        element("source-photo").hidden = !patch;
        const all = this.page.scene.drawable.count / this.group;
        element("source-words").textContent = `Token ${(token + 1).toLocaleString("en")} of ${all.toLocaleString("en")}` +
            (patch ? `: ${config.views[patch.view].name}, patch ${patch.column + 1} across, ${patch.row + 1} down` : "");
        if (!patch) return;
        const photo = await this.photo(patch.view);
        if (this.hovered === token) this.drawPatch(photo, patch);
    }

    async photo(view) {
        if (!this.photos.has(view)) {
            const photo = new Image();
            photo.src = config.views[view].photo;
            this.photos.set(view, photo);
        }
        await this.photos.get(view).decode();
        return this.photos.get(view);
    }

    drawPatch(photo, { row, column }) {
        const canvas = element("source-photo"), [rows, columns] = config.grid, context = canvas.getContext("2d");
        canvas.width = photo.naturalWidth;
        canvas.height = photo.naturalHeight;
        const [width, height] = [canvas.width / columns, canvas.height / rows];
        context.drawImage(photo, 0, 0);
        context.fillStyle = "#0008";
        context.fillRect(0, 0, canvas.width, canvas.height);
        context.drawImage(photo, column * width, row * height, width, height, column * width, row * height, width, height);
        context.strokeStyle = "#fc6";
        context.lineWidth = 2;
        context.strokeRect(column * width - 1, row * height - 1, width + 2, height + 2);
    }
}
