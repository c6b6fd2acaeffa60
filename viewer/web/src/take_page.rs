//! A page in one file that plays a take: `page.wasm`, the drawing and the person stream are inside it, so that it opens from the file system
//! without a server.

use base64::{Engine as _, prelude::BASE64_STANDARD};
use flyrig_types::escape_html;

use crate::hub::Kind;

/// Page that plays a take, filled message by message.
///
/// ```
/// use flyrig_web::TakePage;
///
/// let mut page = TakePage::new("a walk", br#"{"cameras":[],"world_up":[0.0,0.0,1.0]}"#);
/// page.motion(0, 0.1, b"a motion of the stream");
/// let html = page.html();
/// assert!(html.contains("<title>a walk</title>") && !html.contains("src="), "one file");
/// ```
#[derive(Debug, Clone)]
pub struct TakePage {
    title: String,
    messages: Vec<u8>,
}

impl TakePage {
    /// Creates a page without people; `rig` are the cameras and the upward direction, JSON.
    #[must_use]
    pub fn new(title: &str, rig: &[u8]) -> Self {
        let mut page = Self { title: title.to_owned(), messages: Vec::new() };
        page.push(Kind::Rig, 0, 0.0, rig);
        page
    }

    /// Adds a person's template at a time, seconds.
    pub fn template(&mut self, person: u32, seconds: f64, bytes: &[u8]) {
        self.push(Kind::Template, person, seconds, bytes);
    }

    /// Adds a person's motion at a time, seconds; times do not decrease.
    pub fn motion(&mut self, person: u32, seconds: f64, bytes: &[u8]) {
        self.push(Kind::Motion, person, seconds, bytes);
    }

    /// Adds a layer of a person's colours at a time, seconds.
    pub fn colors(&mut self, person: u32, seconds: f64, bytes: &[u8]) {
        self.push(Kind::Colors, person, seconds, bytes);
    }

    /// Appends kind and three zero bytes, person (u32), time (f64, seconds), length (u32), little endian, and the payload.
    fn push(&mut self, kind: Kind, person: u32, seconds: f64, payload: &[u8]) {
        // A message of the stream is limited to a few megabytes.
        let Ok(length) = u32::try_from(payload.len()) else { return };
        self.messages.extend([kind as u8, 0, 0, 0]);
        self.messages.extend(person.to_le_bytes());
        self.messages.extend(seconds.to_le_bytes());
        self.messages.extend(length.to_le_bytes());
        self.messages.extend(payload);
    }

    /// Formats the page.
    #[must_use]
    pub fn html(&self) -> String {
        let drawing = include_str!("../assets/draw_webgl2.js").replace("export class", "class");
        let mut page = String::new();
        let mut rest = include_str!("../assets/take.html");
        // One pass over the template: what is inserted is not searched.
        while let Some((before, after)) = rest.split_once("{{") {
            page.push_str(before);
            let Some((name, after)) = after.split_once("}}") else { break };
            match name {
                "title" => page.push_str(&escape_html(&self.title)),
                "wasm" => BASE64_STANDARD.encode_string(include_bytes!("../assets/page.wasm"), &mut page),
                "take" => BASE64_STANDARD.encode_string(&self.messages, &mut page),
                "drawing" => page.push_str(&drawing),
                _ => page.push_str(include_str!("../assets/take.js")),
            }
            rest = after;
        }
        page.push_str(rest);
        page
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn the_page_is_one_file_with_everything_inside() {
        let mut page = TakePage::new("a <take> & {{wasm}}", b"{}");
        page.template(7, 0.5, b"template");
        page.colors(7, 0.5, &[1, 2, 3]);
        let html = page.html();
        assert!(html.contains("<title>a &lt;take&gt; &amp; {{wasm}}</title>"), "the title is text");
        for outside in ["src=", "href=", "import ", "export ", "fetch(", "http:", "https:", "WebSocket"] {
            assert!(!html.contains(outside), "{outside}");
        }
        let inside = |id: &str| {
            let start = html.split_once(&format!("id=\"{id}\">")).unwrap().1;
            BASE64_STANDARD.decode(start.split_once("</script>").unwrap().0.trim()).unwrap()
        };
        assert_eq!(inside("wasm"), include_bytes!("../assets/page.wasm"));
        let take = inside("take");
        // Rig, template, colours.
        assert_eq!(take.len(), 3 * 20 + 2 + 8 + 3);
        assert_eq!(take[..4], [0, 0, 0, 0]);
        assert_eq!((take[22], take[26]), (1, 7));
        assert!((f64::from_le_bytes(take[30..38].try_into().unwrap()) - 0.5).abs() < 1e-12);
        assert_eq!(take[take.len() - 3..], [1, 2, 3]);
    }
}
