// Where frames come from: the server (fetch and server-sent events), or the recording inside this file.

const QUIET_MS = 15_000;
const MAX_BACKOFF_MS = 8_000;
// Parts of a recording whose frames are kept.
const MAX_UNPACKED = 8;

export function openSource() {
  const embedded = document.getElementById("recording");
  return embedded === null ? new LiveSource() : new RecordedSource(embedded);
}

// The token comes in the address behind `#`, which browsers send to no server.
function tokenOf() {
  const found = new URLSearchParams(location.hash.slice(1)).get("token");
  if (found !== null) {
    sessionStorage.setItem("token", found);
    history.replaceState(null, "", location.pathname);
  }
  return found ?? sessionStorage.getItem("token");
}

export class RequestError extends Error {
  constructor(status, message) { super(message); this.status = status; }
}

class LiveSource {
  constructor() {
    this.token = tokenOf();
    this.isRecorded = false;
    this.lastId = null;
  }

  async #request(path, options = {}) {
    const headers = { ...(options.headers ?? {}) };
    if (this.token !== null) headers.Authorization = `Bearer ${this.token}`;
    const response = await fetch(path, { cache: "no-store", ...options, headers });
    if (!response.ok) {
      const text = await response.json().then((body) => body.error, () => response.statusText);
      throw new RequestError(response.status, text);
    }
    return response;
  }

  async #json(path, options) { return (await this.#request(path, options)).json(); }

  meta() { return this.#json("api/meta"); }
  frame(at_s, signal) { return this.#json(at_s === null ? "api/frame" : `api/frame?at=${at_s}`, { signal }); }
  timeline(from_s, to_s, buckets) { return this.#json(`api/timeline?from=${from_s}&to=${to_s}&buckets=${buckets}`); }
  series(device, from_s, to_s) { return this.#json(`api/series?device=${encodeURIComponent(device)}&from=${from_s}&to=${to_s}`); }
  alarms() { return this.#json("api/alarms"); }
  report() { return this.#json("api/report"); }
  post(path, body) {
    return this.#json(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
  }

  // Calls `on.frame(frame)`, `on.alarms(alarms)` and `on.state("live" | "lost", reason)`, for ever; catches up by Last-Event-ID.
  async listen(on) {
    for (let failures = 0; ; failures += 1) {
      const abort = new AbortController();
      let quiet = 0;
      const expect = () => { clearTimeout(quiet); quiet = setTimeout(() => abort.abort(), QUIET_MS); };
      try {
        expect();
        const response = await this.#request("api/events", { headers: this.lastId === null ? {} : { "Last-Event-ID": this.lastId }, signal: abort.signal });
        on.state("live", "");
        failures = 0;
        const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
        let text = "";
        for (;;) {
          const { done, value } = await reader.read();
          if (done) break;
          expect();
          text += value;
          const events = text.split("\n\n");
          text = events.pop();
          for (const event of events) this.#receive(event, on);
        }
        on.state("lost", "the server closed the connection");
      } catch (error) {
        on.state(error.status === 401 ? "refused" : "lost", error.name === "AbortError" ? "no answer" : error.message);
      } finally {
        clearTimeout(quiet);
      }
      await new Promise((resolve) => setTimeout(resolve, Math.min(MAX_BACKOFF_MS, 500 * 2 ** failures)));
    }
  }

  #receive(event, on) {
    let kind = "message";
    const data = [];
    for (const line of event.split("\n")) {
      if (line.startsWith("event: ")) kind = line.slice(7);
      else if (line.startsWith("data: ")) data.push(line.slice(6));
      else if (line.startsWith("id: ")) this.lastId = line.slice(4);
    }
    if (data.length === 0) return;
    const body = JSON.parse(data.join("\n"));
    if (kind === "frame") on.frame(body);
    else if (kind === "alarms") on.alarms(body);
    else if (kind === "meters") on.meters(body);
  }
}

class RecordedSource {
  constructor(element) {
    this.isRecorded = true;
    this.loaded = unpack(element.textContent).then((text) => JSON.parse(text));
    this.parts = [...document.querySelectorAll("script.frames")];
    this.unpacked = new Map();
  }

  // The frames of one part of the file; the newest few are kept.
  #part(index) {
    const found = this.unpacked.get(index) ?? unpack(this.parts[index].textContent).then((text) => JSON.parse(text));
    this.unpacked.delete(index);
    this.unpacked.set(index, found);
    if (this.unpacked.size > MAX_UNPACKED) this.unpacked.delete(this.unpacked.keys().next().value);
    return found;
  }

  async meta() { return (await this.loaded).meta; }

  async frame(at_s) {
    const { times_s, frames } = await this.loaded;
    let [low, high] = [0, times_s.length - 1];
    if (at_s === null) low = high;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (times_s[middle] <= at_s) low = middle; else high = middle - 1;
    }
    let part = 0;
    while (low >= frames[part]) { low -= frames[part]; part += 1; }
    return (await this.#part(part))[low];
  }

  async timeline(from_s, to_s) {
    const { timeline } = await this.loaded;
    return { ...timeline, buckets: timeline.buckets.filter((bucket) => bucket.end_s >= from_s && bucket.start_s <= to_s) };
  }

  async series(device, from_s, to_s) {
    const found = (await this.loaded).series[device] ?? { charts: [] };
    return { charts: found.charts.map((chart) => {
      const inside = chart.times_s.map((t) => t >= from_s && t <= to_s);
      const cut = (values) => values.filter((_, i) => inside[i]);
      return { ...chart, times_s: cut(chart.times_s), series: chart.series.map((one) => ({ ...one, values: cut(one.values) })) };
    }) };
  }

  async alarms() { return (await this.loaded).alarms; }
  async report() { return (await this.loaded).report; }
  async post() { throw new RequestError(405, "a recording cannot be changed"); }
  async listen(on) { on.state("replay", ""); }
}

// gzip in base64 -> text
async function unpack(text) {
  const bytes = Uint8Array.from(atob(text.trim()), (letter) => letter.codePointAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).text();
}
