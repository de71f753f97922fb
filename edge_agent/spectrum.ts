// Amplitude spectral density of the fused displacement over the last 1024 samples, once a second.
import { Input } from "./types";

type Output = { frequency_hz: number[]; x: number[]; y: number[]; z: number[] };

export const inputs = ["TOPIC"];
export const output = "OUTPUT";

const N = 1024;
let time: number[] = [];
let last = -1;
const axes: number[][] = [[], [], []];

// In place, iterative, radix 2.
function fft(re: number[], im: number[]): void {
  for (let i = 1, j = 0; i < N; i++) {
    let bit = N >> 1;
    for (; j & bit; bit >>= 1) {
      j ^= bit;
    }
    j ^= bit;
    if (i < j) {
      [re[i], re[j]] = [re[j]!, re[i]!];
      [im[i], im[j]] = [im[j]!, im[i]!];
    }
  }
  for (let size = 2; size <= N; size *= 2) {
    for (let start = 0; start < N; start += size) {
      for (let k = 0; k < size / 2; k++) {
        const c = Math.cos((2 * Math.PI * k) / size);
        const s = -Math.sin((2 * Math.PI * k) / size);
        const a = start + k;
        const b = a + size / 2;
        const xr = re[b]! * c - im[b]! * s;
        const xi = re[b]! * s + im[b]! * c;
        re[b] = re[a]! - xr;
        im[b] = im[a]! - xi;
        re[a] = re[a]! + xr;
        im[a] = im[a]! + xi;
      }
    }
  }
}

// mm/sqrt(Hz), one-sided, Hann window, mean removed.
function density(samples: number[], rate: number): number[] {
  const mean = samples.reduce((sum, v) => sum + v, 0) / N;
  const re = samples.map((v, i) => (v - mean) * (1 - Math.cos((2 * Math.PI * i) / N)) / 2);
  const im = new Array<number>(N).fill(0);
  fft(re, im);
  const out: number[] = [];
  for (let k = 1; k < N / 2; k++) {
    out.push(1000 * Math.sqrt((re[k]! * re[k]! + im[k]! * im[k]!) * 2 / (rate * N * 0.375)));
  }
  return out;
}

export default function script(event: Input<"TOPIC">): Output | undefined {
  const { header, displacement_m: d } = event.message;
  const t = header.stamp.sec + header.stamp.nsec * 1e-9;
  const before = time.length > 0 ? time[time.length - 1]! : t;
  if (t < before || t - before > 1) {
    time = []; // sought elsewhere, or a gap: what was there does not belong together
    last = -1;
    axes.forEach((a) => a.splice(0));
  }
  time.push(t);
  axes[0]!.push(d.x);
  axes[1]!.push(d.y);
  axes[2]!.push(d.z);
  if (time.length > N) {
    time.shift();
    axes.forEach((a) => a.shift());
  }
  if (time.length < N || t - last < 1) {
    return undefined;
  }
  last = t;
  const rate = (N - 1) / (t - time[0]!);
  const frequency_hz: number[] = [];
  for (let k = 1; k < N / 2; k++) {
    frequency_hz.push((k * rate) / N);
  }
  return { frequency_hz, x: density(axes[0]!, rate), y: density(axes[1]!, rate), z: density(axes[2]!, rate) };
}
