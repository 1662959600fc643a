use super::colmap::Step;
use std::process::ExitStatus;

#[derive(Default)]
pub struct ColmapOutput {
    pub features: Vec<usize>,
    pub pairs: Option<usize>,
    no_start: bool,
    /// The disk was full; COLMAP 3 reports that without failing.
    pub no_room: bool,
    pairs_follow: bool,
    last: Vec<String>,
}

/// Log lines in an error.
const LAST: usize = 3;

impl ColmapOutput {
    /// Returns the step's finished fraction if the line has one.
    pub fn hear(&mut self, line: &str, photos: usize) -> Option<f64> {
        // Strips glog's prefix.
        let text =
            line.split_once("] ").filter(|(head, _)| head.contains(".cc:")).map_or(line, |(_, text)| text).trim();
        if std::mem::take(&mut self.pairs_follow) {
            self.pairs = number(text);
        }
        if let Some(rest) = text.strip_prefix("Features:") {
            self.features.extend(number(rest));
        } else if let Some(rest) = text.strip_prefix("Loading matches...") {
            self.pairs = number(rest);
            self.pairs_follow = self.pairs.is_none();
        }
        self.no_start |= text.contains("No good initial image pair found") || text.contains("failed to create sparse");
        self.no_room |= ["disk is full", "No space left"].iter().any(|words| text.contains(words));
        let far = progress(text, photos);
        if far.is_none() && text.contains(char::is_alphanumeric) && !text.starts_with("Elapsed time") {
            self.last.push(text.to_owned());
            self.last.drain(..self.last.len().saturating_sub(LAST));
        }
        far
    }

    pub fn found_nothing(&mut self, step: Step, status: ExitStatus) -> bool {
        let no_start = std::mem::take(&mut self.no_start);
        matches!(step, Step::Cameras(_)) && no_start && status.code() == Some(1)
    }

    pub fn last_words(&self) -> String {
        self.last.join("; ")
    }
}

/// Parses a leading number.
fn number(text: &str) -> Option<usize> {
    let text = text.trim_start();
    text[..text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len())].parse().ok()
}

/// Returns the fraction in `Processed file [3/11]`, `Matching block [1/2, 2/2]`, `Registering image
/// #6 (3)` (COLMAP 3), `(num_reg_frames=3)` (COLMAP 4).
fn progress(text: &str, photos: usize) -> Option<f64> {
    if text.starts_with("Registering image") {
        let inside = text.split_once('(')?.1;
        let count = number(inside.trim_start_matches(|c: char| !c.is_ascii_digit()))?;
        return Some((count as f64 / photos as f64).min(1.0));
    }
    if !["Processed file [", "Matching ", "Processing "].iter().any(|start| text.starts_with(start)) {
        return None;
    }
    let counters = text.split_once('[')?.1.split_once(']')?.0;
    let (mut done, mut part) = (0.0, 1.0);
    let mut counters = counters.split(',').peekable();
    while let Some(counter) = counters.next() {
        let (at, of) = counter.split_once('/')?;
        let (at, of): (f64, f64) = (at.trim().parse().ok()?, of.trim().parse().ok()?);
        // Counters except the last name the unfinished item.
        let at = if counters.peek().is_some() { at - 1.0 } else { at };
        part /= of.max(1.0);
        done += at * part;
    }
    Some(done.clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn progress_is_read_from_words_of_both_versions() {
        for (line, far) in [
            ("Processed file [3/12]", Some(0.25)),
            ("I20261123 01:43:37.080578 140044044068544 feature_extraction.cc:270] Processed file [6/12]", Some(0.5)),
            ("Matching block [1/2, 1/2] in 1.2s", Some(0.25)),
            ("Matching block [2/2, 2/2] in 1.2s", Some(1.0)),
            ("I20261123 01:43:40.5 1 pairing.cc:214] Processing block [2/2, 1/2]", Some(0.75)),
            ("Matching image [1/4] in 0.1s", Some(0.25)),
            ("Registering image #6 (3)", Some(0.3)),
            ("I20261123 01:43:43.3 1 incremental_pipeline.cc:620] Registering image #6 (num_reg_frames=5)", Some(0.5)),
            ("  Name:            001.jpg", None),
            ("Processed file [a/b]", None),
        ] {
            assert_eq!(ColmapOutput::default().hear(line, 10), far, "{line}");
        }
    }

    #[test]
    fn pairs_and_features_are_counted() {
        let mut output = ColmapOutput::default();
        let lines = [
            "  Features:        2666",
            "I2 1 2 feature_extraction.cc:294]   Features:        31 (SIFT)",
            "Loading matches... 49 in 0.000s",
        ];
        for line in lines {
            output.hear(line, 3);
        }
        assert_eq!((&output.features[..], output.pairs), (&[2666, 31][..], Some(49)));
        output.hear("I2 1 2 database_cache.cc:144] Loading matches...", 3);
        output.hear("I2 1 2 database_cache.cc:163]  48 in 0.000s", 3);
        assert_eq!(output.pairs, Some(48));
        assert!(!output.no_start);
        output.hear("ERROR: failed to create sparse model", 3);
        assert!(
            output.no_start && output.last_words().ends_with("failed to create sparse model"),
            "{}",
            output.last_words()
        );
    }
}
