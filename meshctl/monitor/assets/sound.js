// A tone on new alarms. Off until its button is pressed: browsers play nothing before.

export class AlarmSound {
  constructor() { this.context = null; }

  get isOn() { return this.context !== null; }

  async toggle() {
    if (this.context === null) {
      this.context = new AudioContext();
      this.play("warning");
    } else {
      const context = this.context;
      this.context = null;
      await context.close();
    }
  }

  // Errors: three high tones; warnings: one low one.
  play(level) {
    if (this.context === null) return;
    const tones = level === "error" ? [880, 660, 880] : [520];
    tones.forEach((hertz, i) => {
      const start = this.context.currentTime + i * 0.22;
      const tone = this.context.createOscillator();
      const gain = this.context.createGain();
      tone.frequency.value = hertz;
      gain.gain.setValueAtTime(0, start);
      gain.gain.linearRampToValueAtTime(0.35, start + 0.02);
      gain.gain.linearRampToValueAtTime(0, start + 0.2);
      tone.connect(gain).connect(this.context.destination);
      tone.start(start);
      tone.stop(start + 0.21);
    });
  }
}
