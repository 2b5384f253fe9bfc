// What a calibration found, in words. Answers are those of the command `calibrate`, see docs/mqtt.md.

const SHOWN = { verdicts: "verdicts", touched: "pads that were touched", fingertips: "fingertips" };
const AGAIN = "Take away what touches the skin and calibrate again.";

/** So many taxels, in words. */
export function inTaxels(n) { return `${n} ${n === 1 ? "taxel" : "taxels"}`; }

/**
 * What the nodes that were asked have answered: the text, its level, and how long it is shown (ms).
 * `part` is the one that was calibrated, null for the whole skin.
 */
export function calibrated(answers, part) {
  const errors = answers.filter(({ ok }) => !ok).map(({ error }) => error);
  const results = answers.filter(({ ok }) => ok).map(({ result }) => result);
  const touched = results.flatMap((result) => [
    ...Object.entries(result.touched ?? {}).map(([name, { length }]) => `${inTaxels(length)} of ${name}`),
    ...Object.entries(result.fingertips ?? {}).filter(([, verdict]) => verdict === "touched").map(([name]) => name),
  ]);
  // From an answer that is larger than the broker takes, keys are left out.
  const absent = Object.keys(SHOWN).filter((key) => results.some((result) => !result[key])).map((key) => SHOWN[key]);
  const wrong = [];
  if (errors.length) wrong.push(errors.join("; "));
  if (touched.length) wrong.push(`Touched while it was calibrated: ${touched.join(", ")}. ${AGAIN}`);
  if (absent.length) wrong.push(`Calibrated, but the answer came without ${absent.join(", ")}: more than the broker takes in one packet. Health names what was touched.`);
  if (results.some(({ kept }) => kept === false)) wrong.push("Calibrated, but it could not be written and is lost when the daemon restarts; health gives the reason.");
  if (wrong.length) return { text: wrong.join(" "), level: errors.length ? "alarm" : "warn", ms: 15000 };
  // The verdicts are of all parts; those of another calibration are not news.
  const verdicts = results.flatMap((result) => Object.entries(result.verdicts)).filter(([name]) => !part || name === part);
  verdicts.sort(([one], [other]) => (one < other ? -1 : 1)); // whichever node was the first to answer
  const counts = verdicts.map(([name, found]) => `${name}: ${Object.entries(found).map(([verdict, n]) => `${n} ${verdict.replaceAll("_", " ")}`).join(", ")}`);
  return { text: `Calibrated. ${counts.length > 3 ? `${counts.length} parts` : counts.join("; ")}`, level: "ok", ms: 6000 };
}
