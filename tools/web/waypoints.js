// Bends the path of a stream toward waypoints on the floor: a port of flame_mdm/sampling/waypoints.py with the same results.
export const NEAR = 0.3; // meters from the root at which a waypoint is reached
const FASTEST = 1.3; // radians per second
const TIGHTEST = 0.7; // meters, the minimum radius of a bend
const ROOM = 1.2; // a waypoint inside a circle larger by this factor is approached from farther away
const PATIENCE = 0.4; // seconds
const SMOOTHING = 0.3; // share of a frame in the average of steps

const remainder = (angle) => angle - 2 * Math.PI * Math.round(angle / 2 / Math.PI);

/** Returns the angles to add to the turns of the root; see `bends` in Python. */
export function bends(turns, steps, heading, place, points, fps) {
  const left = [...points];
  let [x, z] = place, [side, ahead] = steps[0];
  return turns.map((turn, k) => {
    while (left.length && Math.hypot(left[0][0] - x, left[0][1] - z) < NEAR) left.shift();
    side += SMOOTHING * (steps[k][0] - side);
    ahead += SMOOTHING * (steps[k][1] - ahead);
    const travel = heading + Math.atan2(side, ahead);
    const added = left.length ? bend(travel, Math.hypot(side, ahead), [x, z], left[0], fps) : 0;
    const sine = Math.sin(heading), cosine = Math.cos(heading);
    x += cosine * steps[k][0] + sine * steps[k][1];
    z += cosine * steps[k][1] - sine * steps[k][0];
    heading += turn + added;
    return added;
  });
}

function bend(travel, length, place, goal, fps) {
  const most = Math.min(FASTEST / fps, length / TIGHTEST);
  const off = remainder(Math.atan2(goal[0] - place[0], goal[1] - place[1]) - travel);
  const radius = ROOM * Math.max(TIGHTEST, length * fps / FASTEST), side = travel + (off < 0 ? -1 : 1) * Math.PI / 2;
  const center = [place[0] + radius * Math.sin(side), place[1] + radius * Math.cos(side)];
  if (Math.hypot(center[0] - goal[0], center[1] - goal[1]) < radius - NEAR / 2) return 0;
  return Math.max(-most, Math.min(most, off / (PATIENCE * fps)));
}

/** Returns the numbers of the frames in which the first waypoints are reached, of joints (frames * one) from number `begin` on. */
export function reached(points, joints, one, begin) {
  const numbers = [];
  for (let at = 0; at < joints.length; at += one) {
    const near = () => Math.hypot(points[numbers.length][0] - joints[at], points[numbers.length][1] - joints[at + 2]) < NEAR;
    while (numbers.length < points.length && near()) numbers.push(begin + at / one);
  }
  return numbers;
}
