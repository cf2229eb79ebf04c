// The data of the page, for the type checker alone. Boxes are x y z length width height roll pitch
// yaw [m, rad]; null where unknown.

type Box = (number | null)[];
type Point = number[];

interface Figures { flips: number; jitter: number | null; yaw_jitter: number | null; size_spread: number | null; cells: number; iou: number | null }

/** A track of the report, or of an object that a person has added. */
interface Source {
  id: string; class: string; boxes: number; interpolated: number; at: number[]; states: string;
  near: number | null; inputs: string[]; owners: number[] | null; begin: number; seconds: number; points: number | null;
  refined: number | null; status: Record<string, number>; reasons: Record<string, number>;
  shift: number | null; turn: number | null; deviation: number | null; flips: number;
  extents: (number | null)[][]; resized: number | null; before: Figures; after: Figures;
  path: number[][]; rows: number[]; risk: number; riskiest: string; why: string; added: boolean;
  rules: [string, string, string][];
  withdrawn?: boolean; part?: Part;
}

/** A track as decided: its boxes are rows of some sources. */
interface Track extends Source {
  pieces: { s: number; rows: number[] | null }[];
  index: number; rank: number; isWhole: boolean; deleted: number; sharper: number | null;
  members(): [number, number][];
}

/** All boxes of a track, relative to an origin, and points near them [mm]. */
interface Part {
  origin: number[]; stamps: string[]; times: number[]; given: any[]; boxes: any[]; truth: any[];
  iou: (number | null)[][]; sensor: any[]; status: string[]; reasons: string[]; flipped: boolean[];
  change: any[]; deviations: any[]; extent_deviations: any[]; risk: number[]; faces: number[][]; num_points: number[];
  attributes: Record<string, string>[]; counts: number[]; points: Int16Array | number[]; first: number[]; usable: any[];
}

/** A row of decisions.csv. */
interface Row {
  track_id: string; stamp_ns: string; end_ns: string; decision: string; comment: string;
  value: string; box: number[] | null; who?: string; when?: string;
}
type Scope = Pick<Row, 'track_id' | 'stamp_ns' | 'end_ns'>;

interface Report {
  begin_ns: string; frame: string; cell: number; stamps: string[]; times: number[]; states: string[];
  has_truth: boolean; tracks: Source[]; sensor: number[][]; total: Figures[];
}

interface Sweep { stamp: string; origin: number[]; sensor: number[]; points: Float32Array }
interface Camera { topic: string; size: number[]; matrix: number[][] | null; distortion: number[]; model: string; pose: number[][] | null }
type SlimPart = Pick<Part, 'origin' | 'usable' | 'stamps' | 'status'>;
interface SceneBox { s: number; k: number; status: string; track: Track; box: number[]; isGone: boolean }
interface Fit { box: number[]; class: string; points: number; stamp: string; place: number[]; isByHand?: boolean; of?: string }
interface Line { name: string; dash: number[]; corners: Point[] }

interface HTMLCanvasElement { zoom: number; seconds(clientX: number): number; at(pixel: number[]): number[] }
interface HTMLElement { _fullLayout?: any; removeAllListeners?: any; on?: any }
declare const Plotly: any;
