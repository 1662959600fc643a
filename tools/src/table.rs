use indicatif::{HumanBytes, HumanCount};
use std::{fmt, time::Duration};

pub struct Table {
    left: usize,
    rows: Vec<Vec<String>>,
}

impl Table {
    pub fn new(left: usize, headings: &[impl ToString]) -> Self {
        Self { left, rows: vec![headings.iter().map(ToString::to_string).collect()] }
    }

    pub fn row(&mut self, cells: impl Into<Vec<String>>) {
        self.rows.push(cells.into());
    }
}

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let headings = &self.rows[0];
        let width = |column: usize| self.rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
        let widths: Vec<_> = (0..headings.len()).map(width).collect();
        for row in &self.rows {
            let mut line = String::new();
            for (column, (cell, width)) in row.iter().zip(&widths).enumerate() {
                line += &if column < self.left { format!("{cell:<width$}  ") } else { format!("{cell:>width$}  ") };
            }
            writeln!(f, "{}", line.trim_end())?;
        }
        Ok(())
    }
}

pub fn significant(value: f64) -> String {
    let digits = if value.abs() > 0.0 { (3.0 - value.abs().log10().floor()).max(0.0) } else { 4.0 };
    if digits > 8.0 { format!("{value:.3e}") } else { format!("{value:.*}", digits as usize) }
}

/// Formats `1 view`, `2 views`.
pub fn counted(count: usize, what: &str) -> String {
    let plural = if count == 1 { "" } else { "s" };
    format!("{} {what}{plural}", HumanCount(count as u64))
}

/// Formats `1.20 GiB`.
pub fn bytes(count: u64) -> String {
    HumanBytes(count).to_string()
}

/// Formats `1.234 s`, `12.3 ms`.
pub fn time(duration: Duration) -> String {
    let seconds = duration.as_secs_f64();
    if seconds < 1.0 { format!("{:.1} ms", 1e3 * seconds) } else { format!("{seconds:.3} s") }
}
