// Types of steadypose.js. Lengths are in metres, in a right-handed world with z up; stamps are capture times, seconds.

export type Vector = [x: number, y: number, z: number];
export type EventKind =
  | "ENTERED" | "LEFT" | "NEAR" | "STANDS" | "SITS" | "LIES" | "FELL"
  | "HAND_RAISED" | "WAVES" | "POINTS" | "FACES_SENSOR";

export interface Names {
  version: number;
  joints: string[];
  /** index of each joint's parent, -1 for the pelvis */
  parents: number[];
  /** each joint's bone in VRM 1.0 */
  vrm: string[];
  contacts: string[];
  states: ["UNKNOWN", "SEEN", "REFINED", "IMPUTED"];
  events: EventKind[];
}

export interface Body {
  id: number;
  tracking: "OK" | "COASTING" | "LOST";
  /** position of the pelvis */
  root: Vector;
  /** quaternion xyzw, rotates from the body (+x forward, +y left, +z up) to the world */
  orientation: [number, number, number, number];
  /** velocity of the pelvis, m/s */
  velocity: Vector;
  /** positions of the joints, in the order of Names.joints; null where there is no estimate */
  positions: ([number | null, number | null, number | null])[];
  /** quaternions xyzw of the joints, each relative to its parent, the pelvis' to the world; the rest pose is a T-pose that
   *  faces +x, left is +y, up is +z */
  rotations: [number, number, number, number][];
  /** indices into Names.states */
  state: number[];
  /** metres, standard deviation of a position along an axis */
  sigma: (number | null)[];
  /** probabilities, in the order of Names.contacts; null for legs that were not observed for the last 2 s or never */
  contacts: (number | null)[];
  /** position of a joint by name; null where there is no estimate */
  joint(name: string): Vector | null;
}

export interface World {
  topic: "pose/world";
  stamp: number;
  frame: string;
  source: string;
  end: boolean;
  bodies: Body[];
}

export interface PoseEvent {
  body: number;
  kind: EventKind;
  phase: "BEGINS" | "HOLDS" | "ENDS";
  hand: "NONE" | "LEFT" | "RIGHT";
  /** 0 to 1: probability of the condition, given the joints' standard deviations */
  confidence: number | null;
  /** direction of POINTS: unit vector from the head through the wrist */
  direction: Vector | null;
  since: number;
}

export interface PoseEvents {
  topic: "pose/events";
  stamp: number;
  frame: string;
  source: string;
  end: boolean;
  /** all events that begin, hold or end at this time */
  events: PoseEvent[];
}

export interface Health {
  topic: "diagnostics";
  stamp: number;
  node: string;
  level: "OK" | "WARN" | "ERROR" | "STALE";
  message: string;
  values: Record<string, string>;
}

export interface Connection {
  readonly names: Names | null;
  readonly state: "connecting" | "open" | "closed";
  on(kind: "world", handler: (world: World) => void): () => void;
  on(kind: "events", handler: (events: PoseEvents) => void): () => void;
  /** each event that begins or ends, with the source in which `body` is the person's id */
  on(kind: "event", handler: (event: PoseEvent & { source: string }) => void): () => void;
  on(kind: "health", handler: (health: Health) => void): () => void;
  on(kind: "state", handler: (state: "open" | "closed") => void): () => void;
  close(): void;
}

/** Connects, and reconnects whenever the connection is lost. The token follows the # in the printed address. */
export function connect(options?: { token?: string; url?: string }): Connection;
