// Where robots have been up to the shown moment: a line where they were online, dotted where they were not.

export function drawTracks(c, colors, camera, tracks, time_s) {
  c.globalAlpha = 0.6;
  for (const { points } of tracks) {
    for (const isOnline of [false, true]) {
      c.strokeStyle = isOnline ? colors["--accent"] : colors["--stale"];
      c.lineWidth = isOnline ? 3 : 2;
      c.setLineDash(isOnline ? [] : [2, 5]);
      c.beginPath();
      for (let i = 1; i < points.length && points[i][0] <= time_s; i += 1) {
        if (points[i][3] !== isOnline) continue;
        c.moveTo(points[i - 1][1] * camera.scale + camera.x, -points[i - 1][2] * camera.scale + camera.y);
        c.lineTo(points[i][1] * camera.scale + camera.x, -points[i][2] * camera.scale + camera.y);
      }
      c.stroke();
    }
  }
  c.setLineDash([]);
  c.globalAlpha = 1;
}
