//! Code blocks of the guide, and the commands in them.
//!
//! A block is fenced, or indented by four columns or more after a blank line. A comment before it says why it cannot be followed on any
//! computer: `<!-- not run: REASON -->` for the whole block, `<!-- not run (view, calibrate live): REASON -->` for the commands that begin
//! with these words.

/// Programs whose names begin a line of a block of commands.
const PROGRAMS: [&str; 8] = ["flyrig", "make", "cargo", "sudo", "ffmpeg", "curl", "pkill", "journalctl"];
/// Beginning of a mark.
const MARK: &str = "<!-- not run";

/// Part of a page that is set as code.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Block {
    /// Number of the first line in the page, from 1.
    pub line: usize,
    /// Lines without the indentation that they share.
    pub lines: Vec<String>,
    /// Last line of text before the block, which may name the file to write.
    pub before: String,
    /// Commands that are not run: all of them for an empty list; `None` without a mark.
    pub unrun: Option<Vec<String>>,
}

impl Block {
    /// Returns the commands of the block with the numbers of their lines; none for a block of other text.
    #[must_use]
    pub fn commands(&self) -> Vec<(usize, Vec<String>)> {
        let first_word = |line: &String| line.split_whitespace().next().unwrap_or_default().to_owned();
        let is_commands = self.lines.first().is_some_and(|line| PROGRAMS.contains(&first_word(line).as_str()));
        let numbered = self.lines.iter().enumerate().filter(|(_, line)| is_commands && !line.trim().is_empty());
        numbered.map(|(i, line)| (self.line + i, words(line))).filter(|(_, words)| !words.is_empty()).collect()
    }

    /// Returns whether a command of the block is to be run.
    #[must_use]
    pub fn runs(&self, words: &[String]) -> bool {
        let text = words.get(1..).unwrap_or_default().join(" ");
        let begins = |name: &String| text == *name || text.starts_with(&format!("{name} "));
        self.unrun.as_ref().is_none_or(|names| !names.is_empty() && !names.iter().any(begins))
    }

    /// Returns the file that the text before the block asks to write: "Write `rig.toml`".
    #[must_use]
    pub fn file(&self) -> Option<&str> {
        let (_, rest) = self.before.split_once("rite `")?;
        rest.split_once('`').map(|(name, _)| name).filter(|_| self.commands().is_empty())
    }
}

/// Splits a line as a shell does, without its comment. Quotes keep blanks together.
#[must_use]
pub fn words(line: &str) -> Vec<String> {
    let (mut words, mut word, mut quote): (Vec<String>, Option<String>, Option<char>) = (Vec::new(), None, None);
    for character in line.chars() {
        match (quote, character) {
            (Some(open), _) if character == open => quote = None,
            (None, '"' | '\'') => {
                quote = Some(character);
                word.get_or_insert_default();
            }
            (None, '#') if word.is_none() => break,
            (None, _) if character.is_whitespace() => words.extend(word.take()),
            _ => word.get_or_insert_default().push(character),
        }
    }
    words.extend(word);
    words
}

/// Returns the blocks of a page.
#[must_use]
pub fn blocks(page: &str) -> Vec<Block> {
    let lines: Vec<&str> = page.lines().collect();
    let (mut blocks, mut i) = (Vec::new(), 0);
    while i < lines.len() {
        let begin = i;
        let (content, end) = if lines[i].trim_start().starts_with("```") {
            let length = lines[i + 1..].iter().take_while(|line| !line.trim_start().starts_with("```")).count();
            (i + 1..i + 1 + length, i + 2 + length)
        } else if is_indented(lines[i]) && (i == 0 || is_blank(lines[i - 1]) || lines[i - 1].starts_with("<!--")) {
            let length = lines[i..].iter().take_while(|line| is_indented(line) || is_blank(line)).count();
            (i..i + length, i + length)
        } else {
            i += 1;
            continue;
        };
        let mut content: Vec<&str> = lines[content.start..content.end.min(lines.len())].to_vec();
        while content.last().is_some_and(|line| is_blank(line)) {
            content.pop();
        }
        let before = lines[..begin].iter().rev().find(|line| !is_blank(line)).copied().unwrap_or_default();
        let text = lines[..begin].iter().rev().find(|line| !is_blank(line) && !line.trim_start().starts_with("<!--"));
        let first = if lines[begin].trim_start().starts_with("```") { begin + 2 } else { begin + 1 };
        blocks.push(Block {
            line: first,
            lines: without_indent(&content),
            before: text.copied().unwrap_or_default().to_owned(),
            unrun: mark(before),
        });
        i = end;
    }
    blocks
}

fn is_blank(line: &str) -> bool {
    line.trim().is_empty()
}

fn is_indented(line: &str) -> bool {
    line.starts_with("    ") && !is_blank(line)
}

fn without_indent(lines: &[&str]) -> Vec<String> {
    let indent = |line: &&str| line.len() - line.trim_start().len();
    let shared = lines.iter().filter(|line| !is_blank(line)).map(indent).min().unwrap_or(0);
    lines.iter().map(|line| line.get(shared..).unwrap_or_default().to_owned()).collect()
}

/// Returns the commands that a mark names; `None` for a line that is no mark with a reason.
fn mark(line: &str) -> Option<Vec<String>> {
    let (names, reason) = line.trim().strip_prefix(MARK)?.strip_suffix("-->")?.split_once(':')?;
    let names = names.trim().trim_start_matches('(').trim_end_matches(')');
    let names = names.split(',').map(|name| name.trim().to_owned()).filter(|name| !name.is_empty()).collect();
    (!is_blank(reason)).then_some(names)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_are_found_with_their_marks_and_files() {
        let page = "# Title\n\n    flyrig a \"x y\" # comment\n    # by hand\n    flyrig b > c.toml\n\ntext\n\n\
                    1. Write `rig.toml` so:\n\n       [source]\n       kind = \"sim\"\n\n       [rig]\n\n\
                    <!-- not run: needs a desktop -->\n    flyrig view\n\n\
                    <!-- not run (view, calibrate live): needs cameras -->\n```sh\nflyrig view\nflyrig calibrate live x\nflyrig \
                    calibrate board\n```\nend\n";
        let blocks = blocks(page);
        assert_eq!(blocks.len(), 4, "{blocks:?}");
        let first = blocks[0].commands();
        assert_eq!(first[0], (3, vec!["flyrig".to_owned(), "a".to_owned(), "x y".to_owned()]));
        assert_eq!(first[1].1, ["flyrig", "b", ">", "c.toml"]);
        assert!(blocks[0].runs(&first[0].1) && blocks[0].file().is_none());
        assert_eq!((blocks[1].file(), blocks[1].lines.len()), (Some("rig.toml"), 4));
        assert_eq!(blocks[2].unrun, Some(Vec::new()));
        let runs: Vec<bool> = blocks[3].commands().iter().map(|(_, words)| blocks[3].runs(words)).collect();
        assert_eq!((runs, blocks[3].line), (vec![false, false, true], 21));
    }

    #[test]
    fn a_mark_without_a_reason_is_none() {
        assert_eq!(mark("<!-- not run: -->"), None);
        assert_eq!(mark("<!-- something else: x -->"), None);
        assert_eq!(mark("   <!-- not run: it takes hours -->"), Some(Vec::new()));
    }
}
