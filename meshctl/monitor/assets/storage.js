// The browser's storage, for the theme and the reference.

// A page from a file may have no storage.
export function remember(key, value) {
  try { if (value === null) localStorage.removeItem(key); else localStorage.setItem(key, value); } catch { return; }
}

export function recalled(key) {
  try { return JSON.parse(localStorage.getItem(key)); } catch { return null; }
}
