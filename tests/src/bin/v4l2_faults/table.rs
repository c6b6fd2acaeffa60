//! Table of faults.

#[derive(Default)]
pub struct Table(Vec<([String; 5], bool)>);

impl Table {
    /// Adds a row: fault, what was done, what happened, bound, measured.
    pub fn row(&mut self, fault: &str, done: &str, happened: &str, bound: &str, measured: &str, within: bool) {
        let cells = [fault, done, happened, bound, measured].map(|text| text.replace('|', "/").replace('\n', " "));
        println!("{}: {fault}: {done}: {measured}", if within { "ok" } else { "BROKEN" });
        self.0.push((cells, within));
    }

    pub fn all_within(&self) -> bool {
        self.0.iter().all(|(_, within)| *within)
    }

    pub fn print(&self) {
        println!("@@TABLE");
        println!("| fault | what was done | what happened | bound | measured | within |\n|---|---|---|---|---|---|");
        for (cells, within) in &self.0 {
            println!("| {} | {} |", cells.join(" | "), if *within { "yes" } else { "**no**" });
        }
        println!("@@END");
    }
}
