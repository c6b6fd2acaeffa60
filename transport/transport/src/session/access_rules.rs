//! Rules of zenoh's access control: rights of the holders of keys in a session, and what a session with a key accepts.
//!
//! Everything is denied that no rule allows. The gate connects each holder under a common name of its role and number
//! ([`Inner::name`]). zenoh reads rules only when a session is opened, and matches names literally, so rules for all numbers are
//! there from the start: a key that is added later needs no new session.

use flyrig_access::{Inner, KeyFile, MAX_HOLDERS, Ring, Role};
use serde_json::{Value, json};

use crate::keys;

const ALL: [&str; 9] = [
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "declare_queryable",
    "reply",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
];
/// zenoh's names of the flows from a holder and to it.
const FROM: &str = "ingress";
const TO: &str = "egress";

fn rule(id: &str, flow: &str, messages: &[&str], key_exprs: &[String]) -> Value {
    json!({ "id": id, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": key_exprs })
}

/// Rules of a session as zenoh's `access_control`.
#[derive(Default)]
struct Rules {
    rules: Vec<Value>,
    subjects: Vec<Value>,
    policies: Vec<Value>,
}

impl Rules {
    /// Allows a subject everything, in both directions.
    fn allow_everything(&mut self, name: &str, subject: Value) {
        let both = [(FROM, format!("{name}-from")), (TO, format!("{name}-to"))];
        self.rules.extend(both.iter().map(|(flow, id)| rule(id, flow, &ALL, &["**".to_owned()])));
        self.policies.push(json!({ "rules": both.map(|(_, id)| id), "subjects": [name] }));
        self.subjects.push(subject);
    }

    fn control(self) -> Value {
        let Self { rules, subjects, policies } = self;
        json!({ "enabled": true, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies })
    }
}

/// Returns the rules of a session with a key: it accepts only the rig's own certificate name, since zenoh also trusts public
/// authorities.
pub(crate) fn with_key(key: &KeyFile) -> Value {
    let mut rules = Rules::default();
    rules.allow_everything("rig", json!({ "id": "rig", "cert_common_names": [key.rig_certificate_name] }));
    rules.control()
}

/// Returns the rules of a session behind a gate: programs of this computer may do everything, holders of these roles what their role
/// allows, each under its number.
pub(crate) fn behind_gate(ring: &Ring, roles: &[Role]) -> Value {
    let mut all = Rules::default();
    all.allow_everything("local", json!({ "id": "local", "link_protocols": ["tcp"] }));
    let Rules { rules, subjects, policies } = &mut all;
    let rig = ring.rig();
    let key = |rest: &str| keys::key(rig, rest);
    let alive = [keys::any_version_alive(rig)];
    let watched: Vec<String> =
        ["person/**", "view/*", "stats", "calibration/*", "transforms", "splats", "splats/*"].map(key).to_vec();
    let templates = [key("template/*"), key("present/*")];
    let all_viewpoints = [key("viewpoint/*")];
    rules.extend([
        rule("watch-to", TO, &["put"], &watched),
        rule("watch-from", FROM, &["declare_subscriber"], &watched),
        rule("templates-from", FROM, &["query"], &templates),
        rule("templates-to", TO, &["reply", "declare_queryable"], &templates),
        rule("viewpoints-to", TO, &["declare_queryable"], &all_viewpoints),
        rule("alive-to", TO, &["liveliness_token"], &alive),
        rule("alive-from", FROM, &["liveliness_query", "declare_liveliness_subscriber"], &alive),
    ]);
    let watching =
        ["watch-to", "watch-from", "templates-from", "templates-to", "viewpoints-to", "alive-to", "alive-from"];

    // Each holder sends images and clock answers under its own name alone; whether it may send the camera, the receiving side knows.
    let images: Vec<String> = ["camera/*/*", "camera-status/*/*"].map(key).to_vec();
    let hosts = [keys::ANY_HOST.to_owned()];
    rules.extend([
        rule("cameras-to", TO, &["declare_subscriber"], &images),
        rule("hosts-to", TO, &["liveliness_query", "declare_liveliness_subscriber"], &hosts),
    ]);
    let sending = ["cameras-to", "hosts-to"];

    for role in roles {
        for number in 0..MAX_HOLDERS {
            let name = Inner::name(*role, number);
            let own = ring.names_of(number);
            let (shared, own_rules): (&[&str], Vec<Value>) = match role {
                Role::Cameras => {
                    let images: Vec<String> =
                        ["camera/*", "camera-status/*"].map(|label| key(&keys::of_holder(label, &own))).to_vec();
                    let (clock, token) = ([key(&format!("clock/{own}"))], [key(&format!("host/{own}"))]);
                    let own_rules = vec![
                        rule(&format!("{name}-cameras-from"), FROM, &["put"], &images),
                        rule(&format!("{name}-clock-from"), FROM, &["declare_queryable", "reply"], &clock),
                        rule(&format!("{name}-clock-to"), TO, &["query"], &clock),
                        rule(&format!("{name}-host-from"), FROM, &["liveliness_token"], &token),
                    ];
                    (sending.as_slice(), own_rules)
                }
                Role::Viewer | Role::Relay => {
                    let view = [key(&format!("viewer/{own}/view"))];
                    let viewpoint = [key(&format!("viewpoint/{own}"))];
                    let token = [key(&format!("viewer/{own}/alive"))];
                    let own_rules = vec![
                        rule(&format!("{name}-view-to"), TO, &["put"], &view),
                        rule(&format!("{name}-view-from"), FROM, &["declare_subscriber"], &view),
                        rule(&format!("{name}-viewpoint-from"), FROM, &["query"], &viewpoint),
                        rule(&format!("{name}-viewpoint-to"), TO, &["reply"], &viewpoint),
                        rule(&format!("{name}-alive-from"), FROM, &["liveliness_token"], &token),
                    ];
                    (watching.as_slice(), own_rules)
                }
            };
            let ids = own_rules.iter().filter_map(|rule| rule.get("id")?.as_str());
            let allowed: Vec<String> = shared.iter().copied().chain(ids).map(str::to_owned).collect();
            rules.extend(own_rules);
            subjects.push(json!({ "id": name, "cert_common_names": [name] }));
            policies.push(json!({ "rules": allowed, "subjects": [name] }));
        }
    }
    all.control()
}
